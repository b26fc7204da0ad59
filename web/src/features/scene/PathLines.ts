/** The path in the scene: one line per state or speed class in its style. */

import { type PerspectiveCamera, Sphere } from "three";

import { pointOf } from "./axes";
import { OverlayLines } from "./overlayLines";
import { classes, type Colouring, type Path, stylesBy, thinned } from "./path";

/** Drawn after the splats, without a depth test. */
export const OVERLAY_ORDER = 10;
const CASING_PX = 1;
const MOST_POINTS = 20_000;

export class PathLines extends OverlayLines {
  private readonly around = new Sphere();

  constructor() {
    super(OVERLAY_ORDER, CASING_PX);
  }

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
      this.stroke(ends, style);
    });
  }

  /** Scale the dashes to their lengths on the screen; in steps, so that they do not crawl. */
  dashFor(camera: PerspectiveCamera, height_px: number): void {
    const { center, radius } = this.around;
    const away = Math.max(camera.position.distanceTo(center), radius / 2, camera.near);
    const unit_px = height_px / (2 * away * Math.tan((camera.fov * Math.PI) / 360));
    for (const [, stroke] of this.drawn) stroke.material.dashScale = 2 ** Math.round(Math.log2(unit_px));
  }
}
