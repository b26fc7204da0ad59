/** Paths of a comparison in one view: the thick one below, so that it is seen where they agree. */

import { Vector3 } from "three";

import { pointOf } from "./axes";
import { OverlayLines, type Stroke } from "./overlayLines";
import { OVERLAY_ORDER } from "./PathLines";
import { type Path, thinned } from "./path";
import { applied, type Similarity } from "./similarity";

const CASING_PX = 0.8;
const MOST_POINTS = 10_000;

export class ComparedPaths extends OverlayLines {
  /** @param layer which of the paths is drawn over which. */
  constructor(layer: number) {
    super(OVERLAY_ORDER + 2 * layer, CASING_PX);
  }

  /** Draw a path, mapped. */
  set(path: Path, by: Similarity, style: Stroke): void {
    this.clear();
    const points = thinned(path.times.length, MOST_POINTS).map((row) =>
      pointOf(applied(by, new Vector3().fromArray(path.positions, 3 * row)).toArray()),
    );
    this.stroke(
      points.slice(1).flatMap((end, i) => [...(points[i] ?? end).toArray(), ...end.toArray()]),
      style,
    );
  }
}
