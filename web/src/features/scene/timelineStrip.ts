/** The timeline above the scrubber: tracking state over time in the line styles of the path, with marks at missing frames. */

import type { Gap } from "../../shared/api/types";
import { colour } from "../../shared/state/theme";
import { type Path, runs } from "./path";
import { MAX_WIDTH_PX, STATE_STYLES } from "./stateStyles";

export type Missing = Pick<Gap, "first" | "count" | "cause">;

/** Overhang of the marks of missing frames above and below the strip, CSS px. */
const GAP_OVERHANG_PX = 2;

export function paint(canvas: HTMLCanvasElement, path: Path, gaps: readonly Missing[]): void {
  const ratio = window.devicePixelRatio;
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  canvas.width = width;
  canvas.height = height;
  const pen = canvas.getContext("2d");
  const first = path.frames[0] ?? 0;
  const last = path.frames.at(-1) ?? 0;
  if (pen === null || last <= first) return;
  const place = (frame: number): number => ((frame - first) / (last - first)) * width;
  const inner = height - 2 * GAP_OVERHANG_PX * ratio;
  pen.fillStyle = colour("glass");
  pen.fillRect(0, GAP_OVERHANG_PX * ratio, width, inner);
  for (const { state, first: from, end } of runs(path)) {
    const style = STATE_STYLES[state];
    const left = place(path.frames[from] ?? 0);
    const right = Math.max(place(path.frames[Math.min(end, path.frames.length - 1)] ?? 0), left + ratio);
    const thick = (inner * style.width_px) / MAX_WIDTH_PX;
    const [dash, gap] = (style.dash_px ?? [Infinity, 0]).map((length) => length * ratio) as [number, number];
    pen.fillStyle = colour(style.colour);
    for (let x = left; x < right; x += dash + gap)
      pen.fillRect(x, (height - thick) / 2, Math.min(dash, right - x), thick);
  }
  for (const gap of gaps) {
    const wide = Math.max((gap.count / (last - first)) * width, ratio);
    pen.fillStyle = colour("ink");
    pen.fillRect(place(gap.first), 0, wide, height);
    pen.fillStyle = colour("on-glass");
    pen.fillRect(place(gap.first), GAP_OVERHANG_PX * ratio, wide, inner);
  }
}
