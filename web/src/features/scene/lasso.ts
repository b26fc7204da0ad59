/** An outline drawn over the scene: what lies behind it, and how the service is told of it. */

import { MathUtils, type PerspectiveCamera, Quaternion } from "three";

import { poseOf, type ServicePose } from "./axes";
import type { Slots } from "./changes";

/** Corners nearer to the one before than this many pixels are left out, or a multiple of it for a long line. */
const APART_PX = 4;
/** Corners that the service takes. */
const MOST_CORNERS = 1000;

/** As `:clean` takes it: slopes and the view in OpenCV axes. */
export interface Outline {
  corners: [number, number][];
  camera: ServicePose;
}

export type Point = readonly [number, number];

/** The same line with corners further apart, and no more than the service takes. */
export function thinnedLine(points: readonly Point[], apart = APART_PX): Point[] {
  const kept: Point[] = [];
  for (const point of points) {
    const before = kept.at(-1);
    if (before === undefined || Math.hypot(point[0] - before[0], point[1] - before[1]) >= apart) kept.push(point);
  }
  return kept.length <= MOST_CORNERS ? kept : thinnedLine(points, 2 * apart);
}

/** The outline of points in pixels of a canvas of this size, seen by a camera of three.js. */
export function outlineOf(points: readonly Point[], width: number, height: number, camera: PerspectiveCamera): Outline {
  const top = Math.tan(MathUtils.degToRad(camera.fov) / 2);
  const side = (top * width) / height;
  return {
    corners: points.map(([px, py]) => [((2 * px) / width - 1) * side, ((2 * py) / height - 1) * top]),
    camera: poseOf(camera),
  };
}

/** How many splats have their middle inside, by the even-odd rule. */
export function countInside({ arrays, slots, held }: Slots, { corners, camera }: Outline): number {
  const places = new Float32Array(arrays[0].buffer);
  const [cx, cy, cz] = camera.position;
  const [w, x, y, z] = camera.quaternion_wxyz;
  const into = new Quaternion(x, y, z, w).invert();
  let inside = 0;
  for (let slot = 0; slot < slots; slot += 1) {
    if (held[slot] === 0) continue;
    const seen = turn(
      into,
      (places[4 * slot] ?? 0) - cx,
      (places[4 * slot + 1] ?? 0) - cy,
      (places[4 * slot + 2] ?? 0) - cz,
    );
    if (seen[2] > 0 && within(corners, seen[0] / seen[2], seen[1] / seen[2])) inside += 1;
  }
  return inside;
}

/** A vector turned by a unit quaternion. */
function turn(q: Quaternion, x: number, y: number, z: number): [number, number, number] {
  const tx = 2 * (q.y * z - q.z * y);
  const ty = 2 * (q.z * x - q.x * z);
  const tz = 2 * (q.x * y - q.y * x);
  return [x + q.w * tx + q.y * tz - q.z * ty, y + q.w * ty + q.z * tx - q.x * tz, z + q.w * tz + q.x * ty - q.y * tx];
}

function within(corners: readonly Point[], x: number, y: number): boolean {
  let inside = false;
  let [x0, y0] = corners.at(-1) ?? [0, 0];
  for (const [x1, y1] of corners) {
    if (y0 > y !== y1 > y && x < x0 + ((x1 - x0) * (y - y0)) / (y1 - y0)) inside = !inside;
    [x0, y0] = [x1, y1];
  }
  return inside;
}
