/** The point of the scene that a ray meets: where half of its light has been stopped by splats. */

import { utils } from "@sparkjsdev/spark";
import { DataUtils, Quaternion, Vector3 } from "three";

import type { Slots } from "./changes";

/** Words of a splat in each of the two arrays of `Slots`. */
const WORDS = 4;
/** Standard deviations at which a splat ends. */
const REACH = 3;
/** Light that has to be stopped for there to be a surface. */
const SURFACE = 0.5;

interface Met {
  at: number;
  opacity: number;
}

/**
 * The distance along a ray at which half of the light is stopped; null if less is. Origin and direction, of length 1, have
 * the axes of the splats, OpenCV's.
 */
export function distanceAlong(slots: Slots, origin: Vector3, direction: Vector3): number | null {
  const met = metBy(slots, origin, direction).sort((a, b) => a.at - b.at);
  let through = 1;
  for (const one of met) {
    through *= 1 - one.opacity;
    if (1 - through >= SURFACE) return one.at;
  }
  return null;
}

function metBy(slots: Slots, origin: Vector3, direction: Vector3): Met[] {
  const [first, second] = slots.arrays;
  const places = new Float32Array(first.buffer);
  const found: Met[] = [];
  for (let slot = 0; slot < slots.slots; slot += 1) {
    if (slots.held[slot] === 0) continue;
    const at = WORDS * slot;
    const x = (places[at] ?? 0) - origin.x;
    const y = (places[at + 1] ?? 0) - origin.y;
    const z = (places[at + 2] ?? 0) - origin.z;
    const along = x * direction.x + y * direction.y + z * direction.z;
    if (along <= 0) continue;
    const scales = scalesOf(second, at);
    const reach = REACH * Math.max(...scales);
    if (x * x + y * y + z * z - along * along > reach * reach) continue;
    const one = crossing(new Vector3(-x, -y, -z), direction, scales, second[at + 3] ?? 0);
    const opacity = DataUtils.fromHalfFloat((first[at + 3] ?? 0) & 0xffff) * one.density;
    if (one.at > 0 && opacity > 1 / 255) found.push({ at: one.at, opacity: Math.min(opacity, 0.999) });
  }
  return found;
}

function scalesOf(second: Uint32Array, at: number): [number, number, number] {
  const [one, two] = [second[at + 1] ?? 0, second[at + 2] ?? 0];
  return [
    Math.exp(DataUtils.fromHalfFloat(one >>> 16)),
    Math.exp(DataUtils.fromHalfFloat(two & 0xffff)),
    Math.exp(DataUtils.fromHalfFloat(two >>> 16)),
  ];
}

/** Where the ray passes a Gaussian at the origin most closely, by its own measure, and its density there, 0 to 1. */
function crossing(
  start: Vector3,
  direction: Vector3,
  scales: readonly [number, number, number],
  encoded: number,
): { at: number; density: number } {
  const back = utils.decodeQuatOctXy1010R12(encoded, new Quaternion()).conjugate();
  const shrunk = (v: Vector3): Vector3 =>
    v
      .clone()
      .applyQuaternion(back)
      .divide(new Vector3(scales[0], scales[1], scales[2]));
  const from = shrunk(start);
  const along = shrunk(direction);
  const at = -from.dot(along) / along.lengthSq();
  return { at, density: Math.exp(-0.5 * from.addScaledVector(along, at).lengthSq()) };
}
