import { PerspectiveCamera, Vector3 } from "three";
import { expect, test } from "vitest";

import { placementOf, pointOf, poseOfView } from "./axes";
import type { Slots } from "./changes";
import { countInside, outlineOf, thinnedLine } from "./lasso";

const slotsOf = (points: readonly (readonly [number, number, number])[]): Slots => {
  const first = new Uint32Array(4 * points.length);
  const places = new Float32Array(first.buffer);
  points.forEach((point, i) => places.set(point, 4 * i));
  const held = new Uint8Array(points.length).fill(1);
  return { arrays: [first, new Uint32Array(first.length)], slots: points.length, held, splats: points.length };
};

test("what a camera of three.js sees inside a line is what the service will find inside", () => {
  const camera = new PerspectiveCamera(50, 800 / 600, 0.1, 100);
  const pose = placementOf([0.3, -0.2, 0.1], [0.9, 0.1, -0.3, 0.2]);
  camera.position.copy(pose.position);
  camera.quaternion.copy(pose.quaternion);
  camera.updateMatrixWorld();
  let seed = 1;
  const random = (): number => (seed = (seed * 16807) % 2147483647) / 2147483647;
  const points = Array.from({ length: 500 }, () => [4 * random() - 2, 4 * random() - 2, 6 * random() - 2] as const);
  // A box of the canvas, drawn as a line; three.js says which points are in it.
  const [left, right, top, bottom] = [200, 560, 150, 480];
  const wanted = points.filter((point) => {
    const seen = pointOf(point).applyMatrix4(camera.matrixWorldInverse);
    const at = new Vector3().copy(pointOf(point)).project(camera);
    const [x, y] = [(at.x + 1) * 400, (1 - at.y) * 300];
    return seen.z < 0 && x > left && x < right && y > top && y < bottom;
  });
  const line = [
    [left, top],
    [right, top],
    [right, bottom],
    [left, bottom],
  ] as const;
  const outline = outlineOf(line, 800, 600, camera);
  expect(wanted.length).toBeGreaterThan(10);
  expect(countInside(slotsOf(points), outline)).toBe(wanted.length);
  const slots = slotsOf(points);
  slots.held.fill(0);
  expect(countInside(slots, outline)).toBe(0);
});

test("corners of a line that is drawn are apart", () => {
  const line = Array.from({ length: 100 }, (_, i) => [i, 0] as const);
  expect(thinnedLine(line)).toHaveLength(25);
  expect(thinnedLine([])).toEqual([]);
});

test("a view is a pose of the service that looks at its target, upright", () => {
  const view = [0.5, 1.2, 3, -0.4, 0.1, -1, 55];
  const pose = poseOfView(view);
  const placed = placementOf(pose.position, pose.quaternion_wxyz);
  const target = new Vector3(...view.slice(3, 6)).sub(placed.position).applyQuaternion(placed.quaternion.invert());
  expect(target.x).toBeCloseTo(0);
  expect(target.y).toBeCloseTo(0);
  expect(target.z).toBeLessThan(0); // cameras of three.js look along -z
  const up = new Vector3(0, 1, 0).applyQuaternion(placed.quaternion);
  expect(up.x).toBeCloseTo(0);
  expect(up.y).toBeGreaterThan(0);
});
