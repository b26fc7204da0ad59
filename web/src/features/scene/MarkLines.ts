/** What is being measured: crosses at the points, and lines between them. */

import { Vector3 } from "three";

import { OverlayLines, type Stroke } from "./overlayLines";

/** Drawn after all else. */
const ORDER = 20;
const CASING_PX = 1.2;
const STROKE: Stroke = { colour: "mark", width_px: 2.5, dash_px: null };

export class MarkLines extends OverlayLines {
  constructor() {
    super(ORDER, CASING_PX);
  }

  /** @param size of the crosses, in units of the scene. @param closed whether the last point is joined with the first. */
  set(points: readonly Vector3[], size: number, closed: boolean): void {
    this.clear();
    const ends = points.flatMap((point, i) => {
      const next = points[i + 1] ?? (closed && points.length > 2 ? points[0] : undefined);
      return [...cross(point, size), ...(next === undefined ? [] : [...point.toArray(), ...next.toArray()])];
    });
    this.stroke(ends, STROKE);
  }
}

const AXES = [new Vector3(1, 0, 0), new Vector3(0, 1, 0), new Vector3(0, 0, 1)];

const cross = (at: Vector3, size: number): number[] =>
  AXES.flatMap((axis) => [-size, size].flatMap((far) => at.clone().addScaledVector(axis, far).toArray()));
