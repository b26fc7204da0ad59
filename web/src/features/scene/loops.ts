/** Closed loops in the scene: an arc between the two places of the camera, with a diamond at each. */

import type { Vector3 } from "three";

import type { Closure } from "../../shared/api/types";
import { pointOf } from "./axes";
import { OverlayLines } from "./overlayLines";
import { type Path, rowAtTime } from "./path";

/** Drawn after the path. */
const ORDER = 14;
const USUAL_PX = 2;
const NEWEST_PX = 5;
const CASING_PX = 1.2;
const ARC_STEPS = 16;
/** Height of an arc, as a share of the way between its ends, and at least of the size of a diamond. */
const ARC_HEIGHT = 0.25;

export class LoopLines extends OverlayLines {
  constructor() {
    super(ORDER, CASING_PX);
  }

  /** @param size of the diamonds, in units of the scene. @param fresh how many of the last closures are highlighted. */
  set(path: Path, closures: readonly Closure[], size: number, fresh: number): void {
    this.clear();
    if (path.times.length === 0) return;
    const usual = closures.length - fresh;
    this.draw(path, closures.slice(0, usual), size, USUAL_PX);
    this.draw(path, closures.slice(usual), 1.6 * size, NEWEST_PX);
  }

  private draw(path: Path, closures: readonly Closure[], size: number, width_px: number): void {
    const ends = closures.flatMap((one) => edges(placeAt(path, one.earlier_s), placeAt(path, one.later_s), size));
    this.stroke(ends, { colour: "mark", width_px, dash_px: null });
  }
}

function placeAt(path: Path, time_s: number): Vector3 {
  const row = rowAtTime(path, time_s);
  return pointOf([...path.positions.subarray(3 * row, 3 * row + 3)]);
}

/** Coordinates of line segments: the arc, which rises above its ends, and the diamonds. */
function edges(from: Vector3, to: Vector3, size: number): number[] {
  const height = Math.max(ARC_HEIGHT * from.distanceTo(to), size);
  const at = (share: number): Vector3 => {
    const point = from.clone().lerp(to, share);
    point.y += 4 * height * share * (1 - share);
    return point;
  };
  const arc = Array.from({ length: ARC_STEPS }, (_, i) => [at(i / ARC_STEPS), at((i + 1) / ARC_STEPS)]).flat();
  const diamonds = [from, to].flatMap((end) => {
    const corner = (x: number, y: number, z: number): Vector3 =>
      end.clone().add({ x: size * x, y: size * y, z: size * z });
    const [left, right, top, bottom] = [corner(-0.5, 0, 0), corner(0.5, 0, 0), corner(0, 0.5, 0), corner(0, -0.5, 0)];
    const [near, far] = [corner(0, 0, 0.5), corner(0, 0, -0.5)];
    const around = [left, near, near, right, right, far, far, left];
    return [...around, ...[left, near, right, far].flatMap((one) => [one, top, one, bottom])];
  });
  return [...arc, ...diamonds].flatMap((point) => point.toArray());
}
