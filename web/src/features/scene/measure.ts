/** Lengths, angles and the direction of up, from points of the scene in the axes of three.js. */

import { Vector3 } from "three";

import type { Scale } from "../../shared/api/types";

export const TOOLS = [
  { value: "distance", label: "Distance", points: 2, ask: "Click two points." },
  { value: "angle", label: "Angle", points: 3, ask: "Click three points; the angle is at the second." },
  { value: "up", label: "Up", points: 3, ask: "Click three points of the floor, far from each other." },
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

/** How certain a scale is; empty if that is not known. */
export const spreadText = (scale: Scale | null): string =>
  scale?.sigma == null ? "" : ` ± ${(100 * scale.sigma).toPrecision(2)} %`;
