import { DataUtils, PerspectiveCamera, Quaternion, Vector3 } from "three";
import { expect, it } from "vitest";

import type { Trajectory } from "../../shared/api/types";
import { placementOf, projectionOf } from "./axes";
import { classes, pathOf, rowAt, runs, stylesBy, speeds, thinned } from "./path";
import { SPEED_STYLES, STATE_STYLES, STATES } from "./stateStyles";
import { containing, moved, zoomed } from "./timelineWindow";
import { distanceAlong } from "./picker";
import { applied, inverse, pathOfTum, rmsDistance, type Similarity, similarityOf } from "./similarity";
import { readBookmarks, writeBookmarks } from "./bookmarks";

const straight = (n: number): Trajectory => ({
  version: 1,
  frames: Array.from({ length: n }, (_, i) => 8 * i + 4),
  times_s: Array.from({ length: n }, (_, i) => (8 * i + 4.5) / 20_000),
  positions: Array.from({ length: n }, (_, i) => [0.01 * i, 0, 0]),
  quaternions_wxyz: Array.from({ length: n }, () => [1, 0, 0, 0]),
  states: Array.from({ length: n }, (_, i) => (i < 2 ? "boot" : "track")),
});

/** Pixel of a point given in OpenCV's world, through three.js. */
function pixel(point: number[], position: number[], wxyz: number[]): [number, number] {
  const k = { fx: 350, fy: 340, cx: 190, cy: 130 };
  const camera = new PerspectiveCamera();
  const placement = placementOf(position, wxyz);
  camera.position.copy(placement.position);
  camera.quaternion.copy(placement.quaternion);
  camera.updateMatrixWorld();
  camera.projectionMatrix.copy(projectionOf(k, 400, 250, 0.01, 100));
  const [x = 0, y = 0, z = 0] = point;
  const seen = new Vector3(x, -y, -z).applyMatrix4(camera.matrixWorldInverse).applyMatrix4(camera.projectionMatrix);
  return [((seen.x + 1) / 2) * 400, ((1 - seen.y) / 2) * 250];
}

it("sees a point at the pixel where a pinhole camera with OpenCV's axes sees it", () => {
  // Right 0.2, down 0.1, forward 2: u = 350 * 0.1 + 190, v = 340 * 0.05 + 130.
  const [u, v] = pixel([0.2, 0.1, 2], [0, 0, 0], [1, 0, 0, 0]);
  expect(u).toBeCloseTo(225, 3);
  expect(v).toBeCloseTo(147, 3);
  // A camera at x = 1 turned 90 degrees about y (down) looks along +x: what is at x = 3 is 2 ahead of it.
  const half = Math.SQRT1_2;
  const [u2, v2] = pixel([3, 0.1, -0.2], [1, 0, 0], [half, 0, half, 0]);
  expect(u2).toBeCloseTo(225, 3);
  expect(v2).toBeCloseTo(147, 3);
});

it("finds the pose nearest to a frame", () => {
  const path = pathOf(straight(100));
  expect(rowAt(path, -5)).toBe(0);
  expect(rowAt(path, 4)).toBe(0);
  expect(rowAt(path, 9)).toBe(1);
  expect(rowAt(path, 1e9)).toBe(99);
  expect(rowAt(pathOf(straight(0)), 3)).toBe(-1);
});

it("continues with live poses after the end of the published path", () => {
  const tail = [4, 804, 812].map((frame) => ({
    frame,
    time_s: (frame + 0.5) / 20_000,
    position: [9, 9, 9] as [number, number, number],
    quaternion_wxyz: [1, 0, 0, 0] as [number, number, number, number],
    state: "track" as const,
  }));
  const path = pathOf(straight(100), tail);
  expect([...path.frames.slice(-3)]).toEqual([796, 804, 812]);
});

it("measures speed and draws by state", () => {
  const path = pathOf(straight(50));
  for (const speed of speeds(path)) expect(speed).toBeCloseTo(0.01 / (8 / 20_000), 2);
  const drawn = [...classes(path, "state")].map((which) => stylesBy("state")[which]?.name);
  expect(drawn.slice(0, 3)).toEqual(["boot", "boot", "track"]);
  expect(drawn.at(-1)).toBe("track");
  expect(runs(path)).toEqual([
    { state: "boot", first: 0, end: 2 },
    { state: "track", first: 2, end: 50 },
  ]);
});

it("draws what is faster by a later class", () => {
  const slower = straight(200);
  slower.positions = slower.times_s.map((_, i) => [0.00005 * i * i, 0, 0]);
  const drawn = [...classes(pathOf(slower), "speed")];
  expect(drawn).toEqual([...drawn].sort((a, b) => a - b));
  expect(new Set(drawn).size).toBe(SPEED_STYLES.length);
});

it("tells states and speeds apart without their colours: by dashes or by width", () => {
  for (const styles of [STATES.map((state) => STATE_STYLES[state]), SPEED_STYLES]) {
    for (const [i, one] of styles.entries()) {
      for (const other of styles.slice(i + 1)) {
        const [a, b] = [one, other].map(({ dash_px: dash }) => (dash === null ? 1 : dash[0] / (dash[0] + dash[1])));
        const apart = Math.abs(one.width_px - other.width_px) >= 1 || Math.abs((a ?? 0) - (b ?? 0)) > 0.15;
        expect(apart, `${one.name} and ${other.name}`).toBe(true);
      }
    }
  }
});

it("thins evenly and keeps both ends", () => {
  expect(thinned(5, 10)).toEqual([0, 1, 2, 3, 4]);
  const rows = thinned(1000, 11);
  expect([rows.length, rows[0], rows.at(-1)]).toEqual([11, 0, 999]);
});

it("keeps bookmarks and ignores what is not one", () => {
  const mark = { name: "View 1", camera: [1, 2, 3, 4, 5, 6, 55], frame: null };
  writeBookmarks("c", [mark]);
  expect(readBookmarks("c")).toEqual([mark]);
  localStorage.setItem("spiked.bookmarks.c", '[{"name": "x", "camera": [1]}, 3]');
  expect(readBookmarks("c")).toEqual([]);
  localStorage.setItem("spiked.bookmarks.c", "{");
  expect(readBookmarks("c")).toEqual([]);
});

it("zooms the timeline around a frame, keeps it inside, and shows everything again", () => {
  const whole = { first: 0, last: 1_200_000 };
  const once = zoomed(null, whole, 4, 900_000);
  expect(once).toEqual({ first: 675_000, last: 975_000 });
  expect(moved(once, whole, 1_000_000)).toEqual({ first: 900_000, last: 1_200_000 });
  expect(moved(once, whole, -1_000_000)).toEqual({ first: 0, last: 300_000 });
  expect(containing(once, whole, 980_000)).toEqual({ first: 680_000, last: 980_000 });
  expect(containing(once, whole, 700_000)).toBe(once);
  expect(zoomed(once, whole, 1 / 5, 0)).toBeNull();
  const close = zoomed(null, whole, 1e9, 5);
  expect((close?.last ?? 0) - (close?.first ?? 0)).toBe(100);
  expect(zoomed(null, { first: 3, last: 50 }, 2, 10)).toBeNull();
  expect(moved(null, whole, 5)).toBeNull();
});

it("finds the distance at which half of the light along a ray is stopped", () => {
  const half = (x: number): number => DataUtils.toHalfFloat(x);
  const places = new Float32Array([0, 0, 2, 0, 0.1, 0, 3, 0, 0, 0, 5, 0]);
  const first = new Uint32Array(places.buffer);
  const second = new Uint32Array(12);
  [0.3, 0.4, 0.9].forEach((opacity, slot) => {
    first[4 * slot + 3] = half(opacity);
    const size = half(Math.log(slot === 1 ? 10 : 0.1));
    second[4 * slot + 1] = size << 16;
    second[4 * slot + 2] = size | (size << 16);
  });
  const slots = {
    arrays: [first, second] as [Uint32Array, Uint32Array],
    slots: 3,
    held: new Uint8Array([1, 1, 1]),
    splats: 3,
  };
  const ahead = new Vector3(0, 0, 1);
  // 0.3 of the light is stopped at 2, and 0.4 of what is left at 3.
  expect(distanceAlong(slots, new Vector3(), ahead)).toBeCloseTo(3, 2);
  slots.held[1] = 0;
  expect(distanceAlong(slots, new Vector3(), ahead)).toBeCloseTo(5, 2);
  expect(distanceAlong(slots, new Vector3(1, 0, 0), ahead)).toBeNull();
});

/** A path that winds, and the same one seen in other coordinates. */
function wound(by: Similarity, n = 60): Trajectory {
  const turnOf = (i: number): Quaternion => new Quaternion().setFromAxisAngle(new Vector3(0, 1, 0), 0.02 * i);
  return {
    ...straight(n),
    positions: Array.from({ length: n }, (_, i) =>
      applied(by, new Vector3(Math.sin(0.1 * i), 0.3 * Math.cos(0.2 * i), 0.05 * i)).toArray(),
    ),
    quaternions_wxyz: Array.from({ length: n }, (_, i) => {
      const { x, y, z, w } = by.rotation.clone().multiply(turnOf(i));
      return [w, x, y, z];
    }),
  };
}
const SOME: Similarity = {
  scale: 2.5,
  rotation: new Quaternion(0.1, -0.5, 0.3, 0.8).normalize(),
  translation: new Vector3(1, -2, 3),
};
const NONE: Similarity = { scale: 1, rotation: new Quaternion(), translation: new Vector3() };

it.each(["places", "turns"] as const)("lays a path over another by its %s", (by) => {
  const [from, to] = [pathOf(wound(NONE)), pathOf(wound(SOME))];
  const found = similarityOf(from, to, by);
  expect(found).not.toBeNull();
  if (found === null) return;
  expect(found.scale).toBeCloseTo(2.5, 4);
  expect(found.rotation.angleTo(SOME.rotation)).toBeLessThan(1e-3);
  expect(found.translation.distanceTo(SOME.translation)).toBeLessThan(1e-3);
  expect(rmsDistance(from, to, found)).toBeLessThan(1e-4);
  const point = new Vector3(0.3, 0.1, -2);
  expect(applied(inverse(found), applied(found, point)).distanceTo(point)).toBeLessThan(1e-6);
});

it("lays straight paths over each other by their orientations", () => {
  const turned = new Quaternion().setFromAxisAngle(new Vector3(1, 0, 0), 1.2); // about the path itself
  const other = straight(50);
  const { x, y, z, w } = turned;
  const found = similarityOf(
    pathOf(straight(50)),
    pathOf({ ...other, quaternions_wxyz: other.frames.map(() => [w, x, y, z]) }),
    "turns",
  );
  expect(found?.rotation.angleTo(turned)).toBeLessThan(1e-3);
});

it("measures how far a path is from the truth at its own times", () => {
  const truth = pathOf(straight(100));
  const off = straight(100);
  off.positions = off.positions.map(([px = 0], i) => [px, i % 2 === 0 ? 0.01 : -0.01, 0]);
  off.times_s = off.times_s.map((time) => time + 0.0001); // between the poses of the truth
  const distance = rmsDistance(pathOf(off), truth, {
    ...NONE,
    translation: new Vector3(0.0025, 0, 0), // 0.1 ms at 25 units a second
  });
  expect(distance).toBeCloseTo(0.01, 4);
  expect(similarityOf(truth, pathOf(straight(2)), "places")).toBeNull();
});

it("reads a TUM file, and names the line that is none", () => {
  const path = pathOfTum("# t x y z qx qy qz qw\n0.1 1 2 3 0 0 0 1\n0.2 1 2 4 0 0.6 0 0.8\n0.3 1 2 5 0 0 0 1\n", 1000);
  expect([...path.frames]).toEqual([100, 200, 300].map((one) => one - 0.5).map(Math.round));
  expect([...path.positions.subarray(3, 6)]).toEqual([1, 2, 4]);
  expect(path.quaternions[6]).toBeCloseTo(0.6);
  expect(path.quaternions[4]).toBeCloseTo(0.8);
  expect(() => pathOfTum("0.1 1 2 3 0 0 0 1\n0.2 1 2\n", 1000)).toThrow("Line 2 is no pose");
  expect(() => pathOfTum("0.1 1 2 3 0 0 0 1\n", 1000)).toThrow("has 1 poses");
});
