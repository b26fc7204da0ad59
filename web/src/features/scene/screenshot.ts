/** Pictures of what is seen on the stage, as it is shown or of another size. */

import { composed, type Layer, partOf, WHOLE } from "./composing";
import type { Comparison as Ride } from "./RideAlong";
import type { Size, Viewer } from "./Viewer";

/** What lies over the first scene. */
export type Over =
  | { kind: "nothing" }
  | { kind: "scene"; viewer: Viewer; how: "side" | "wipe" | "difference" }
  | { kind: "camera"; picture: HTMLImageElement | null; how: Ride };

/** A PNG file of the stage around a viewer, and its size; `share` is where the line of a wipe is. */
export async function screenshot(
  viewer: Viewer,
  over: Over,
  share: number,
  wanted: Size | null,
): Promise<{ file: Blob; size: Size }> {
  const stage = viewer.canvas.parentElement ?? viewer.canvas;
  const size =
    wanted === null
      ? { width: viewer.sharpness * stage.clientWidth, height: viewer.sharpness * stage.clientHeight }
      : viewer.sizeOf(wanted);
  const whole = { width: Math.round(size.width), height: Math.round(size.height) };
  if (over.kind === "nothing") return { file: await viewer.picture(whole), size: whole };
  const layers = await layersOf(viewer, over, share, whole, stage);
  return { file: await composed(whole, layers, over.how === "wipe" ? share : null), size: whole };
}

async function layersOf(
  viewer: Viewer,
  over: Exclude<Over, { kind: "nothing" }>,
  share: number,
  size: Size,
  stage: Element,
): Promise<Layer[]> {
  const scene = async (one: Viewer): Promise<Layer> => {
    const at = over.how === "side" ? partOf(one.canvas, stage) : WHOLE;
    const part = { width: Math.round(at.width * size.width), height: Math.round(at.height * size.height) };
    return { picture: await createImageBitmap(await one.picture(part)), at, seen: [0, 1], difference: false };
  };
  const below = await scene(viewer);
  const difference = over.how === "difference";
  if (over.kind === "scene")
    return [below, { ...(await scene(over.viewer)), seen: over.how === "wipe" ? [share, 1] : [0, 1], difference }];
  if (over.picture === null || over.how === "rendered") return [below];
  return [below, { picture: over.picture, at: WHOLE, seen: over.how === "wipe" ? [0, share] : [0, 1], difference }];
}
