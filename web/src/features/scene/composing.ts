/** What is seen of a stage of several layers as one picture: two scenes, or a scene and the picture of the camera. */

import { colour } from "../../shared/state/theme";
import type { Size } from "./Viewer";

/** Gain of pictures of differences; `.brightened` in the style sheet has it, too. */
export const DIFFERENCE_GAIN = 4;
/** Width of the line of a wipe, as a share of the width of the picture. */
const LINE = 1 / 600;

/** A part of a stage, in shares of its width and height. */
export interface Part {
  left: number;
  top: number;
  width: number;
  height: number;
}

export interface Layer {
  picture: CanvasImageSource;
  /** Where it lies. */
  at: Part;
  /** From where to where across the stage it is seen, shares. */
  seen: readonly [number, number];
  /** Whether its difference from what is below is shown. */
  difference: boolean;
}

export const WHOLE: Part = { left: 0, top: 0, width: 1, height: 1 };

/** Where an element lies in another one. */
export function partOf(element: Element, within: Element): Part {
  const [inner, outer] = [element.getBoundingClientRect(), within.getBoundingClientRect()];
  return {
    left: (inner.left - outer.left) / outer.width,
    top: (inner.top - outer.top) / outer.height,
    width: inner.width / outer.width,
    height: inner.height / outer.height,
  };
}

/** A PNG file of layers, the lowest first, and of the line of a wipe at a share of its width. */
export async function composed(size: Size, layers: readonly Layer[], line: number | null): Promise<Blob> {
  const { width, height } = size;
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d");
  if (context === null) throw new Error(`This browser draws no picture of ${width} × ${height}: choose a smaller one.`);
  context.fillStyle = colour("viewport");
  context.fillRect(0, 0, width, height);
  for (const { picture, at, seen, difference } of layers) {
    context.save();
    context.beginPath();
    context.rect(seen[0] * width, 0, (seen[1] - seen[0]) * width, height);
    context.clip();
    context.globalCompositeOperation = difference ? "difference" : "source-over";
    context.drawImage(picture, at.left * width, at.top * height, at.width * width, at.height * height);
    context.restore();
  }
  if (layers.some((one) => one.difference)) {
    context.globalCompositeOperation = "lighter";
    for (let gain = 1; gain < DIFFERENCE_GAIN; gain *= 2) context.drawImage(canvas, 0, 0); // doubles all
    context.globalCompositeOperation = "source-over";
  }
  if (line !== null) {
    const thick = Math.max(2, Math.round(LINE * width));
    context.fillStyle = colour("on-glass");
    context.fillRect(Math.round(line * width - thick / 2), 0, thick, height);
  }
  return canvas.convertToBlob({ type: "image/png" });
}
