/** What is being measured: crosses at the points, and lines between them. */

import { Color, Group, Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

import { colour } from "../../shared/state/theme";

/** Drawn after all else. */
const ORDER = 20;
const WIDTH_PX = 2.5;
const CASING_PX = 1.2;

export class MarkLines extends Group {
  private drawn: LineSegments2[] = [];

  /** @param size of the crosses, in units of the scene. @param closed whether the last point is joined with the first. */
  set(points: readonly Vector3[], size: number, closed: boolean): void {
    this.clear();
    if (points.length === 0) return;
    const ends = points.flatMap((point, i) => {
      const next = points[i + 1] ?? (closed && points.length > 2 ? points[0] : undefined);
      return [...cross(point, size), ...(next === undefined ? [] : [...point.toArray(), ...next.toArray()])];
    });
    const geometry = new LineSegmentsGeometry().setPositions(ends);
    const outline = new LineMaterial({ linewidth: WIDTH_PX + 2 * CASING_PX, color: new Color(colour("glass")) });
    const stroke = new LineMaterial({ linewidth: WIDTH_PX, color: new Color(colour("mark")) });
    this.drawn = [outline, stroke].map((material, above) => {
      material.depthTest = false;
      material.transparent = true;
      const line = new LineSegments2(geometry, material);
      line.frustumCulled = false;
      line.renderOrder = ORDER + above;
      return line;
    });
    this.add(...this.drawn);
  }

  override clear(): this {
    this.drawn[0]?.geometry.dispose(); // shared by the line and its outline
    for (const line of this.drawn) line.material.dispose();
    this.drawn = [];
    return super.clear();
  }
}

const AXES = [new Vector3(1, 0, 0), new Vector3(0, 1, 0), new Vector3(0, 0, 1)];

const cross = (at: Vector3, size: number): number[] =>
  AXES.flatMap((axis) => [-size, size].flatMap((far) => at.clone().addScaledVector(axis, far).toArray()));
