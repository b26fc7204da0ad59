/** The timeline above the scrubber: tracking state over time in the line styles of the path, missing frames, closed loops. */

import type { Closure, Gap, Timeline } from "../../shared/api/types";
import { colour } from "../../shared/state/theme";
import { MAX_WIDTH_PX, STATE_STYLES } from "./stateStyles";
import type { Span } from "./timelineWindow";

export type Missing = Pick<Gap, "first" | "count" | "cause">;

/** Overhang of the marks of missing frames above and below the strip, CSS px. */
const OVERHANG_PX = 2;
/** Half the width of the mark of a closed loop, CSS px. */
const LOOP_PX = 4;

/** Frames that follow each other in one state: those of `(after, to]`. */
export function stretches(timeline: Timeline): { state: Timeline["state"][number]; after: number; to: number }[] {
  const result: { state: Timeline["state"][number]; after: number; to: number }[] = [];
  timeline.frame.forEach((to, i) => {
    const state = timeline.state[i] ?? "track";
    const before = result.at(-1);
    if (before?.state === state) before.to = to;
    else result.push({ state, after: before?.to ?? Math.max(0, 2 * to - (timeline.frame[i + 1] ?? to)), to });
  });
  return result;
}

/** Paint timelines over one another: a coarse one of everything, and a fine one of what is shown. */
export function paint(
  canvas: HTMLCanvasElement,
  timelines: readonly Timeline[],
  shown: Span,
  rateHz: number | null,
): void {
  const ratio = window.devicePixelRatio;
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  canvas.width = width;
  canvas.height = height;
  const pen = canvas.getContext("2d");
  if (pen === null || shown.last <= shown.first) return;
  const place = (frame: number): number => ((frame - shown.first) / (shown.last - shown.first)) * width;
  const over = OVERHANG_PX * ratio;
  const inner = height - 2 * over;
  pen.fillStyle = colour("glass");
  pen.fillRect(0, over, width, inner);
  for (const timeline of timelines) {
    const seen = stretches(timeline);
    const from = place(seen[0]?.after ?? 0);
    pen.fillStyle = colour("glass");
    pen.fillRect(from, over, place(seen.at(-1)?.to ?? 0) - from, inner);
    for (const { state, after, to } of seen) {
      const style = STATE_STYLES[state];
      const left = Math.round(Math.max(place(after), 0)); // whole pixels: gaps between dashes stay dark
      const right = Math.min(Math.max(place(to), left + ratio), width);
      const thick = Math.round((inner * style.width_px) / MAX_WIDTH_PX);
      const [dash, gap] = (style.dash_px ?? [Infinity, 0]).map((length) => length * ratio) as [number, number];
      pen.fillStyle = colour(style.colour);
      for (let x = left; x < right; x += dash + gap)
        pen.fillRect(x, Math.floor((height - thick) / 2), Math.min(dash, right - x), thick);
    }
    for (const gap of timeline.gaps) {
      const wide = Math.max(place(gap.first + gap.count) - place(gap.first), ratio);
      pen.fillStyle = colour("ink");
      pen.fillRect(place(gap.first), 0, wide, height);
      pen.fillStyle = colour("on-glass");
      pen.fillRect(place(gap.first), over, wide, inner);
    }
  }
  if (rateHz === null) return;
  for (const loop of timelines[0]?.closures ?? []) mark(pen, loop, place, rateHz, height, ratio);
}

/** A full diamond where the loop was closed, an empty one at the earlier sight of the place. */
function mark(
  pen: CanvasRenderingContext2D,
  loop: Closure,
  place: (frame: number) => number,
  rateHz: number,
  height: number,
  ratio: number,
): void {
  const reach = LOOP_PX * ratio;
  for (const time of [loop.earlier_s, loop.later_s]) {
    const x = place(time * rateHz);
    pen.beginPath();
    pen.moveTo(x - reach, height / 2);
    pen.lineTo(x, height / 2 - reach);
    pen.lineTo(x + reach, height / 2);
    pen.lineTo(x, height / 2 + reach);
    pen.closePath();
    pen.fillStyle = colour(time === loop.later_s ? "mark" : "glass");
    pen.strokeStyle = colour(time === loop.later_s ? "glass" : "mark");
    pen.lineWidth = 1.5 * ratio;
    pen.fill();
    pen.stroke();
  }
}
