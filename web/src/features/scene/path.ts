/** The camera path over time: positions, tracking states, speeds. */

import type { Pose, TrackingState, Trajectory } from "../../shared/api/types";
import { type LineStyle, SPEED_STYLES, STATE_STYLES, STATES } from "./stateStyles";

export type Colouring = "state" | "speed";

/** State of poses without a recorded state. */
const USUAL: TrackingState = "track";

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
export const rowAt = (path: Path, frame: number): number => nearest(path.frames, frame);

/** Row of the pose nearest to a time in seconds; -1 for an empty path. */
export const rowAtTime = (path: Path, time_s: number): number => nearest(path.times, time_s);

function nearest(sorted: Float64Array, wanted: number): number {
  const n = sorted.length;
  if (n === 0) return -1;
  let low = 0;
  let high = n - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((sorted[middle] ?? 0) < wanted) low = middle + 1;
    else high = middle;
  }
  const before = sorted[low - 1];
  return before !== undefined && wanted - before < (sorted[low] ?? 0) - wanted ? low - 1 : low;
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

export const stateAt = (path: Path, row: number): TrackingState => path.states[row] ?? USUAL;

/** Rows that follow each other in one state: `[first, end)`. */
export function runs(path: Path): { state: TrackingState; first: number; end: number }[] {
  const result: { state: TrackingState; first: number; end: number }[] = [];
  for (let row = 0; row < path.states.length; row += 1) {
    const state = stateAt(path, row);
    const before = result.at(-1);
    if (before?.state === state) before.end = row + 1;
    else result.push({ state, first: row, end: row + 1 });
  }
  return result;
}

export const stylesBy = (by: Colouring): readonly LineStyle[] =>
  by === "state" ? STATES.map((state) => STATE_STYLES[state]) : SPEED_STYLES;

/** [n] which of `stylesBy` each pose has; the fastest class begins at four fifths of what the fastest 2 % exceed. */
export function classes(path: Path, by: Colouring): Uint8Array {
  if (by === "state") return Uint8Array.from(path.states, (_, row) => STATES.indexOf(stateAt(path, row)));
  const speed = speeds(path);
  const fastest = Math.max(1e-12, quantile(speed, 0.98));
  const most = SPEED_STYLES.length;
  return Uint8Array.from(speed, (v) => Math.min(Math.floor((v / fastest) * most), most - 1));
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
