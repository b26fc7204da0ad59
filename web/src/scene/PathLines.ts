/** The path in the scene: for each state or class of speed a line of its own colour, width and dash, on a dark one that shows it on any scene. */

import { Color, Group, type PerspectiveCamera, Sphere } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

import { colour } from "../state/theme";
import { pointOf } from "./axes";
import { classes, type Colouring, type Path, signsBy, thinned } from "./path";
import type { Sign } from "./signs";

/** Drawn after the splats, whatever lies before it. */
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
    signsBy(by).forEach((sign, which) => {
      const ends = points
        .slice(1)
        .flatMap((end, i) => (of[rows[i] ?? 0] === which ? [...(points[i] ?? end).toArray(), ...end.toArray()] : []));
      if (ends.length > 0) this.drawn.push(...lines(sign, ends));
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

  /** Make dashes as long on the screen as their signs say, for a canvas of so many pixels; in steps, so that they do not crawl. */
  dashFor(camera: PerspectiveCamera, height_px: number): void {
    const { center, radius } = this.around;
    const away = Math.max(camera.position.distanceTo(center), radius / 2, camera.near);
    const unit_px = height_px / (2 * away * Math.tan((camera.fov * Math.PI) / 360));
    for (const line of this.drawn) line.material.dashScale = 2 ** Math.round(Math.log2(unit_px));
  }
}

/** The dark line and the one over it. */
function lines(sign: Sign, ends: readonly number[]): LineSegments2[] {
  const geometry = new LineSegmentsGeometry().setPositions([...ends]);
  const casing = new LineMaterial({ linewidth: sign.width_px + 2 * CASING_PX, color: new Color(colour("glass")) });
  const [dash, gap] = sign.dash_px ?? [1, 0];
  const stroke = new LineMaterial({
    linewidth: sign.width_px,
    color: new Color(colour(sign.colour)),
    dashed: sign.dash_px !== null,
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
