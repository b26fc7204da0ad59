/** How states and speeds are told apart, by more than colour: a width and a dash, the same on the path, the band and the legend. */

import type { TrackingState } from "../api/types";

export interface Sign {
  name: string;
  /** Name of a colour of the style sheet, without its dashes. */
  colour: string;
  width_px: number;
  /** Lengths of a dash and of the gap after it; `null` for an unbroken line. */
  dash_px: readonly [number, number] | null;
}

/** The widest of all, px. */
export const MOST_WIDTH_PX = 7;

export const STATE_SIGNS: Record<TrackingState, Sign> = {
  boot: { name: "boot", colour: "state-boot", width_px: 2.5, dash_px: [3, 3] },
  track: { name: "track", colour: "state-track", width_px: 3, dash_px: null },
  degraded: { name: "degraded", colour: "state-degraded", width_px: 4.5, dash_px: [11, 4] },
  lost: { name: "lost", colour: "state-lost", width_px: MOST_WIDTH_PX, dash_px: [3, 9] },
  reloc: { name: "reloc", colour: "state-reloc", width_px: 5.5, dash_px: [5, 4] },
};
export const STATES = Object.keys(STATE_SIGNS) as TrackingState[];

/** From slow to fast. */
export const SPEED_SIGNS: readonly Sign[] = [1.5, 2.5, 3.5, 5, MOST_WIDTH_PX].map((width_px, i) => ({
  name: `speed-${i}`,
  colour: `speed-${i}`,
  width_px,
  dash_px: null,
}));
