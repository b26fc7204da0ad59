/** The path in the scene: one line per state or speed class in its style, over a dark outline that keeps it visible. */

import { Color, Group, type PerspectiveCamera, Sphere } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

import { colour } from "../../shared/state/theme";
import { pointOf } from "./axes";
import { classes, type Colouring, type Path, stylesBy, thinned } from "./path";
import type { LineStyle } from "./stateStyles";

/** Drawn after the splats, without a depth test. */
export const OVERLAY_ORDER = 10;
const CASING_PX = 1;
const MOST_POINTS = 20_000;

export class PathLines extends Group {
  private readonly around = new Sphere();
  private drawn: LineSegments2[] = [];

  set(path: Path, by: Colouring): void {
    this.clear();
    const rows = thinned(path.times.length, MOST_POINTS);
    const points = rows.map((row) => pointOf([...path.positions.subarray(3 * row, 3 * row + 3)]));
    if (points.length < 2) return;
    this.around.setFromPoints(points);
    const of = classes(path, by);
    stylesBy(by).forEach((style, which) => {
      const ends = points
        .slice(1)
        .flatMap((end, i) => (of[rows[i] ?? 0] === which ? [...(points[i] ?? end).toArray(), ...end.toArray()] : []));
      if (ends.length > 0) this.drawn.push(...lines(style, ends));
    });
    this.add(...this.drawn);
  }

  override clear(): this {
    for (const line of this.drawn) {
      line.geometry.dispose();
      line.material.dispose();
    }
    this.drawn = [];
    return super.clear();
  }

  /** Scale the dashes to their lengths on the screen; in steps, so that they do not crawl. */
  dashFor(camera: PerspectiveCamera, height_px: number): void {
    const { center, radius } = this.around;
    const away = Math.max(camera.position.distanceTo(center), radius / 2, camera.near);
    const unit_px = height_px / (2 * away * Math.tan((camera.fov * Math.PI) / 360));
    for (const line of this.drawn) line.material.dashScale = 2 ** Math.round(Math.log2(unit_px));
  }
}

/** The outline and the line over it. */
function lines(style: LineStyle, ends: readonly number[]): LineSegments2[] {
  const geometry = new LineSegmentsGeometry().setPositions([...ends]);
  const casing = new LineMaterial({ linewidth: style.width_px + 2 * CASING_PX, color: new Color(colour("glass")) });
  const [dash, gap] = style.dash_px ?? [1, 0];
  const stroke = new LineMaterial({
    linewidth: style.width_px,
    color: new Color(colour(style.colour)),
    dashed: style.dash_px !== null,
    dashSize: dash,
    gapSize: gap,
  });
  return [casing, stroke].map((material, above) => {
    material.depthTest = false;
    material.transparent = true;
    const line = new LineSegments2(geometry, material).computeLineDistances();
    line.frustumCulled = false;
    line.renderOrder = OVERLAY_ORDER + above;
    return line;
  });
}
