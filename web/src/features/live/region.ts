/** A rectangle of pixels of the upright picture. */

export interface Region {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** A drag shorter than this many pixels of the camera means one pixel. */
const CLICK = 2;

const clamp = (value: number, low: number, high: number): number => Math.min(Math.max(value, low), high);

/** The pixels between two corners, in pixels of the camera; of a click the one below it. */
export function dragged(from: [number, number], to: [number, number], size: { width: number; height: number }): Region {
  const across = (at: 0 | 1, limit: number): [number, number] => {
    const ends = [from[at], to[at]].map((value) => clamp(Math.floor(value), 0, limit - 1));
    return [Math.min(...ends), Math.max(...ends)];
  };
  const [left, right] = across(0, size.width);
  const [top, bottom] = across(1, size.height);
  if (right - left < CLICK && bottom - top < CLICK) return within({ x: left, y: top, width: 1, height: 1 }, size);
  return { x: left, y: top, width: right - left + 1, height: bottom - top + 1 };
}

/** The part of a region that is in a picture of this size, one pixel at least. */
export function within(region: Region, size: { width: number; height: number }): Region {
  const x = clamp(Math.round(region.x), 0, size.width - 1);
  const y = clamp(Math.round(region.y), 0, size.height - 1);
  return {
    x,
    y,
    width: clamp(Math.round(region.width), 1, size.width - x),
    height: clamp(Math.round(region.height), 1, size.height - y),
  };
}

export const same = (a: Region, b: Region): boolean =>
  a.x === b.x && a.y === b.y && a.width === b.width && a.height === b.height;

export const isPixel = (region: Region): boolean => region.width === 1 && region.height === 1;

/** Mean and standard deviation of the frames between spikes; null of fewer than two spikes. */
export function intervals(spikes: readonly number[]): { mean: number; deviation: number } | null {
  const between = spikes.slice(1).map((frame, i) => frame - (spikes[i] ?? frame));
  if (between.length === 0) return null;
  const mean = between.reduce((sum, one) => sum + one, 0) / between.length;
  return { mean, deviation: Math.sqrt(between.reduce((sum, one) => sum + (one - mean) ** 2, 0) / between.length) };
}
