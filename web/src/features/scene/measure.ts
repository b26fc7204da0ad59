/** Lengths, angles and the direction of up, from points of the scene in the axes of three.js. */

import { Vector3 } from "three";

import type { Scale } from "../../shared/api/types";

export const TOOLS = [
  { value: "distance", label: "Distance", points: 2, ask: "Tap or click two points." },
  { value: "angle", label: "Angle", points: 3, ask: "Tap or click three points; the angle is at the second." },
  { value: "up", label: "Up", points: 3, ask: "Tap or click three points of the floor, far from each other." },
] as const;
export type Tool = (typeof TOOLS)[number]["value"];

export const pointsOf = (tool: Tool): number => TOOLS.find((one) => one.value === tool)?.points ?? 0;

export const distance = (points: readonly Vector3[]): number | null => {
  const [a, b] = points;
  return a === undefined || b === undefined ? null : a.distanceTo(b);
};

/** At the second of three points, degrees. */
export const angle = (points: readonly Vector3[]): number | null => {
  const [a, b, c] = points;
  if (a === undefined || b === undefined || c === undefined) return null;
  return (a.clone().sub(b).angleTo(c.clone().sub(b)) * 180) / Math.PI;
};

/** The normal of the floor through three points, on the side of the eye, in the axes of the scene, OpenCV's. */
export const upOf = (points: readonly Vector3[], eye: Vector3): [number, number, number] | null => {
  const [a, b, c] = points;
  if (a === undefined || b === undefined || c === undefined) return null;
  const normal = b.clone().sub(a).cross(c.clone().sub(a));
  if (normal.lengthSq() === 0) return null;
  normal.normalize();
  if (normal.dot(eye.clone().sub(a)) < 0) normal.negate();
  return [normal.x, -normal.y, -normal.z];
};

/** A length of the scene in words: in metres where the scale is known. */
export function lengthText(length: number, scale: Scale | null): string {
  const metres = scale?.metres_per_unit ?? null;
  if (metres === null) return `${length.toPrecision(4)} units`;
  return `${(length * metres).toPrecision(4)} m${spreadText(scale)}`;
}

/** OpenCV's sets of markers of ChArUco boards, as the service names them. */
export const MARKERS: readonly string[] = [4, 5, 6, 7].flatMap((side) =>
  [50, 100, 250, 1000].map((count) => `${side}x${side}_${count}`),
);

/** Three numbers with blanks, commas or semicolons between them. Throws an error that says so for another text. */
export function vectorOf(text: string): [number, number, number] {
  const [x, y, z, ...more] = text
    .trim()
    .split(/[\s,;]+/)
    .map((part) => (part === "" ? NaN : Number(part)));
  if (x === undefined || y === undefined || z === undefined || more.length > 0 || !Number.isFinite(x + y + z))
    throw new Error(`Write three numbers, as 0.1 9.7 0.9, not “${text}”.`);
  return [x, y, z];
}

const SOURCES: Record<NonNullable<Scale["source"]>, string> = {
  length: "a known length",
  tag: "a tag",
  board: "a board",
  baseline: "the distance of two cameras",
};

/** What is known of the unit of a scene, and of up. */
export function scaleText(scale: Scale | null): string {
  const metres = scale?.metres_per_unit ?? null;
  const unit =
    metres === null
      ? "The scale is not known: a moving camera alone knows no metres."
      : `A unit is ${metres.toPrecision(5)} m${spreadText(scale)}, by ${SOURCES[scale?.source ?? "length"]}.`;
  return `${unit} Up is ${scale?.up == null ? "not known" : "known"}.`;
}

/** How certain a scale is; empty if that is not known. */
export const spreadText = (scale: Scale | null): string =>
  scale?.sigma == null ? "" : ` ± ${(100 * scale.sigma).toPrecision(2)} %`;
