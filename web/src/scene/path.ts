/** The path of the camera over time: where it was, how it tracked, how fast it went. */

import type { Pose, TrackingState, Trajectory } from "../api/types";

export type Colouring = "state" | "speed";

/** Okabe and Ito's palette, told apart by people with any common colour blindness; the legend names each. */
export const STATE_COLOURS: Record<TrackingState, string> = {
  boot: "#56b4e9",
  track: "#009e73",
  degraded: "#e69f00",
  lost: "#d55e00",
  reloc: "#cc79a7",
};
export const STATES = Object.keys(STATE_COLOURS) as TrackingState[];

/** From slow to fast, as in the colour map cividis, which reads the same without red or green. */
export const SPEED_COLOURS = ["#00224e", "#35456c", "#666970", "#948e77", "#c8b866", "#fee838"] as const;
const SPEED_RGB = SPEED_COLOURS.map(rgbOf);

export interface Path {
  frames: Float64Array;
  times: Float64Array;
  /** [3 n] OpenCV axes. */
  positions: Float32Array;
  /** [4 n] wxyz. */
  quaternions: Float32Array;
  states: (TrackingState | null)[];
}

export function pathOf(trajectory: Trajectory, tail: readonly Pose[] = []): Path {
  const fresh = tail.filter((pose) => pose.time_s > (trajectory.times_s.at(-1) ?? -1));
  const times = Float64Array.from([...trajectory.times_s, ...fresh.map((pose) => pose.time_s)]);
  return {
    frames: Float64Array.from([...trajectory.frames, ...fresh.map((pose) => pose.frame)]),
    times,
    positions: Float32Array.from([...trajectory.positions.flat(), ...fresh.flatMap((pose) => pose.position)]),
    quaternions: Float32Array.from([
      ...trajectory.quaternions_wxyz.flat(),
      ...fresh.flatMap((pose) => pose.quaternion_wxyz),
    ]),
    states: [...trajectory.states, ...fresh.map((pose) => pose.state)],
  };
}

/** Row of the pose nearest to a frame; -1 for an empty path. */
export function rowAt(path: Path, frame: number): number {
  const n = path.frames.length;
  if (n === 0) return -1;
  let low = 0;
  let high = n - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((path.frames[middle] ?? 0) < frame) low = middle + 1;
    else high = middle;
  }
  const before = path.frames[low - 1];
  return before !== undefined && frame - before < (path.frames[low] ?? 0) - frame ? low - 1 : low;
}

/** Speeds, length units of the scene a second: centred differences over some poses, against the noise of single ones. */
export function speeds(path: Path, reach = 4): Float32Array {
  const n = path.times.length;
  const result = new Float32Array(n);
  for (let i = 0; i < n; i += 1) {
    const a = Math.max(0, i - reach);
    const b = Math.min(n - 1, i + reach);
    const dt = (path.times[b] ?? 0) - (path.times[a] ?? 0);
    let square = 0;
    for (let k = 0; k < 3; k += 1) square += ((path.positions[3 * b + k] ?? 0) - (path.positions[3 * a + k] ?? 0)) ** 2;
    result[i] = dt > 0 ? Math.sqrt(square) / dt : 0;
  }
  return result;
}

function rgbOf(hex: string): [number, number, number] {
  const n = Number.parseInt(hex.slice(1), 16);
  return [(n >> 16) / 255, ((n >> 8) & 255) / 255, (n & 255) / 255];
}

/** [3 n] colours of the poses, sRGB, 0 to 1. */
export function colours(path: Path, by: Colouring): Float32Array {
  const n = path.times.length;
  const result = new Float32Array(3 * n);
  if (by === "state") {
    for (let i = 0; i < n; i += 1) result.set(rgbOf(STATE_COLOURS[path.states[i] ?? "track"]), 3 * i);
    return result;
  }
  const speed = speeds(path);
  const fastest = Math.max(1e-12, quantile(speed, 0.98));
  for (let i = 0; i < n; i += 1) {
    const at = Math.min((speed[i] ?? 0) / fastest, 1) * (SPEED_RGB.length - 1);
    const below = Math.min(Math.floor(at), SPEED_RGB.length - 2);
    const a = SPEED_RGB[below] ?? [0, 0, 0];
    const b = SPEED_RGB[below + 1] ?? a;
    for (let k = 0; k < 3; k += 1) result[3 * i + k] = (a[k] ?? 0) + (at - below) * ((b[k] ?? 0) - (a[k] ?? 0));
  }
  return result;
}

export function quantile(values: Float32Array, share: number): number {
  if (values.length === 0) return 0;
  const sorted = Float32Array.from(values).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] ?? 0;
}

/** At most `most` rows, evenly, the first and the last among them. */
export function thinned(n: number, most: number): number[] {
  if (n <= most) return Array.from({ length: n }, (_, i) => i);
  return Array.from({ length: most }, (_, i) => Math.round((i * (n - 1)) / (most - 1)));
}
