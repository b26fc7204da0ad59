/** Line styles of tracking states, speeds and compared paths: colour, width and dash; the same on path, timeline and legend. */

import type { TrackingState } from "../../shared/api/types";

export interface LineStyle {
  name: string;
  /** CSS variable of the colour, without the leading dashes. */
  colour: string;
  width_px: number;
  /** Lengths of dash and gap; `null`: solid. */
  dash_px: readonly [number, number] | null;
}

/** Largest width, px. */
export const MAX_WIDTH_PX = 7;

export const STATE_STYLES: Record<TrackingState, LineStyle> = {
  boot: { name: "boot", colour: "state-boot", width_px: 2.5, dash_px: [3, 3] },
  track: { name: "track", colour: "state-track", width_px: 3, dash_px: null },
  degraded: { name: "degraded", colour: "state-degraded", width_px: 4.5, dash_px: [11, 4] },
  lost: { name: "lost", colour: "state-lost", width_px: MAX_WIDTH_PX, dash_px: [3, 9] },
  reloc: { name: "reloc", colour: "state-reloc", width_px: 5.5, dash_px: [5, 4] },
};
export const STATES = Object.keys(STATE_STYLES) as TrackingState[];

/** From slow to fast. */
export const SPEED_STYLES: readonly LineStyle[] = [1.5, 2.5, 3.5, 5, MAX_WIDTH_PX].map((width_px, i) => ({
  name: `speed-${i}`,
  colour: `speed-${i}`,
  width_px,
  dash_px: null,
}));

/** Of a comparison: the thick one is drawn below, so that both are seen where they agree. */
export const COMPARED_STYLES: Record<"first" | "second" | "truth", LineStyle> = {
  first: { name: "first", colour: "path-first", width_px: 6, dash_px: null },
  second: { name: "second", colour: "path-second", width_px: 3, dash_px: null },
  truth: { name: "truth", colour: "path-truth", width_px: 1.2, dash_px: null },
};
