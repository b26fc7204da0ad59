/** Lines drawn over the splats: a stroke over a dark outline that keeps it visible on any ground. */

import { Color, Group } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

import { colour } from "../../shared/state/theme";
import type { LineStyle } from "./stateStyles";

export type Stroke = Pick<LineStyle, "colour" | "width_px" | "dash_px">;

/** A group of outlined strokes; each of `clear` and a new drawing frees what was drawn before. */
export class OverlayLines extends Group {
  /** Outline and stroke of each drawing, which share a geometry. */
  protected readonly drawn: [LineSegments2, LineSegments2][] = [];

  /** @param order after which other lines this is drawn. @param casing_px width of the outline at each side. */
  constructor(
    private readonly order: number,
    private readonly casing_px: number,
  ) {
    super();
  }

  /** Add line segments, two points each. */
  protected stroke(ends: readonly number[], style: Stroke): void {
    if (ends.length === 0) return;
    const geometry = new LineSegmentsGeometry().setPositions([...ends]);
    const [dash, gap] = style.dash_px ?? [1, 0];
    const outline = new LineMaterial({
      linewidth: style.width_px + 2 * this.casing_px,
      color: new Color(colour("glass")),
    });
    const stroke = new LineMaterial({
      linewidth: style.width_px,
      color: new Color(colour(style.colour)),
      dashed: style.dash_px !== null,
      dashSize: dash,
      gapSize: gap,
    });
    const line = (material: LineMaterial, above: number): LineSegments2 => {
      material.depthTest = false;
      material.transparent = true;
      const made = new LineSegments2(geometry, material).computeLineDistances();
      made.frustumCulled = false;
      made.renderOrder = this.order + above;
      return made;
    };
    const pair: [LineSegments2, LineSegments2] = [line(outline, 0), line(stroke, 1)];
    this.drawn.push(pair);
    this.add(...pair);
  }

  override clear(): this {
    for (const [outline, stroke] of this.drawn) {
      outline.geometry.dispose();
      outline.material.dispose();
      stroke.material.dispose();
    }
    this.drawn.length = 0;
    return super.clear();
  }
}
