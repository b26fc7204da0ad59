/** A box along the axes of the scene, cut from its sides. */

/** In the axes of the scene, OpenCV's. */
export interface Box {
  low: readonly [number, number, number];
  high: readonly [number, number, number];
}

/** x points right, y down and z ahead. */
export const SIDES = ["left", "right", "top", "bottom", "near", "far"] as const;

/** Shares that are cut off at each of `SIDES`. */
export const NO_CUT: readonly number[] = SIDES.map(() => 0);
/** Share of each side that stays at least. */
const LEAST = 0.02;
/** Beyond every splat. */
const FAR = 1e9;

/** `box` without the sides that nothing is cut from: there may be splats beyond those that were loaded. */
export function opened(box: Box, shares: readonly number[]): Box {
  const low = (k: 0 | 1 | 2): number => ((shares[2 * k] ?? 0) > 0 ? box.low[k] : -FAR);
  const high = (k: 0 | 1 | 2): number => ((shares[2 * k + 1] ?? 0) > 0 ? box.high[k] : FAR);
  return { low: [low(0), low(1), low(2)], high: [high(0), high(1), high(2)] };
}

/** The box without a share of it at each side. */
export function cut(bounds: Box, shares: readonly number[]): Box {
  const axis = (k: 0 | 1 | 2): [number, number] => {
    const [low, size] = [bounds.low[k], bounds.high[k] - bounds.low[k]];
    const before = Math.min(shares[2 * k] ?? 0, 1 - LEAST);
    const after = Math.min(shares[2 * k + 1] ?? 0, 1 - LEAST - before);
    return [low + before * size, low + (1 - Math.max(after, 0)) * size];
  };
  const [x, y, z] = [axis(0), axis(1), axis(2)];
  return { low: [x[0], y[0], z[0]], high: [x[1], y[1], z[1]] };
}
