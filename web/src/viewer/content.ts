/** What an exported page holds beside this script: the scene, and the path of the camera through it. */

import type { Sensor } from "../shared/api/types";
import { type Changes, readChanges } from "../features/scene/changes";
import type { Path } from "../features/scene/path";

/** As `spiked.export.viewer_page` writes it. */
interface Written {
  name: string;
  sensor: Sensor | null;
  times_s: number[];
  frames: number[];
  positions: number[][];
  quaternions_wxyz: number[][];
}

export interface Content {
  name: string;
  sensor: Sensor | null;
  path: Path;
  scene: Changes;
}

const text = (id: string): string => document.getElementById(id)?.textContent ?? "";

/** Reads the two elements. Throws for a page that was cut short. */
export async function readContent(): Promise<Content> {
  const packed = Uint8Array.from(atob(text("scene").trim()), (byte) => byte.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const scene = readChanges(await new Response(stream).arrayBuffer());
  const written = JSON.parse(text("about")) as Written;
  return {
    name: written.name,
    sensor: written.sensor,
    scene,
    path: {
      frames: Float64Array.from(written.frames),
      times: Float64Array.from(written.times_s),
      positions: Float32Array.from(written.positions.flat()),
      quaternions: Float32Array.from(written.quaternions_wxyz.flat()),
      states: written.frames.map(() => null),
    },
  };
}
