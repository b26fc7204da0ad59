/** Data series for the plots of a timeline. */

import type { Timeline } from "../../shared/api/types";

export interface PlotSpec {
  key: "sigma_px" | "chi2" | "loss" | "psnr_db" | "rate";
  title: string;
  unit: string;
  log: boolean;
  hint: string;
}

export const PLOTS: readonly PlotSpec[] = [
  {
    key: "sigma_px",
    title: "Pose σ",
    unit: "px",
    log: false,
    hint: "Standard deviation of the pose, projected into the image",
  },
  {
    key: "chi2",
    title: "χ²",
    unit: "",
    log: false,
    hint: "Squared residual divided by its expectation from the noise; 1 is expected",
  },
  {
    key: "loss",
    title: "Loss",
    unit: "",
    log: true,
    hint: "Mean squared error of the views, relative to white squared",
  },
  { key: "psnr_db", title: "PSNR estimate", unit: "dB", log: false, hint: "Of the training views" },
  { key: "rate", title: "Spike rate", unit: "/frame", log: false, hint: "Mean spikes a pixel and frame" },
];

export type Column = (number | null)[];

/** What plots are over: the time of the capture, or the seconds that the reconstruction worked. */
export type Axis = "capture" | "work";

/** A series over one of the axes; the map goes on after the last frame, which only work shows. */
export function along(timeline: Timeline, key: PlotSpec["key"], axis: Axis): [number[], Column] {
  if (axis === "capture") return [timeline.time_s, timeline[key]];
  if (key === "loss" || key === "psnr_db") return [timeline.work.work_s, timeline.work[key]];
  const known = timeline.work_s.flatMap((work, row) => (work === null ? [] : [[work, row] as const]));
  return [known.map(([work]) => work), known.map(([, row]) => timeline[key][row] ?? null)];
}

/** Whether the work was noted, which releases before this one did not. */
export const hasWork = (timeline: Timeline): boolean =>
  timeline.work.work_s.length > 0 || timeline.work_s.some((work) => work !== null);

/** Two timelines on one time axis: the sorted times of both, and the values of each, null where it has none. */
export function joined(times: readonly (readonly number[])[], values: readonly Column[]): [number[], ...Column[]] {
  const all = [...new Set(times.flat())].sort((a, b) => a - b);
  const columns = values.map((column, i) => {
    const at = new Map((times[i] ?? []).map((time, row) => [time, column[row] ?? null]));
    return all.map((time) => at.get(time) ?? null);
  });
  return [all, ...columns];
}

/**
 * Flicker: deviation of the spike rate from its mean over 10 ms, in percent of that mean. 10 ms is one period of the light
 * of lamps on 50 Hz mains, and about one on 60 Hz.
 */
export function flicker(timeline: Timeline): Column {
  const period = 0.01;
  const { time_s: times, rate } = timeline;
  let first = 0;
  let end = 0;
  return times.map((time, i) => {
    while ((times[first] ?? Infinity) < time - period / 2) first += 1;
    while (end < times.length && (times[end] ?? Infinity) <= time + period / 2) end += 1;
    const around = rate.slice(first, end).filter((x) => x !== null);
    const own = rate[i] ?? null;
    const mean = around.reduce((sum, x) => sum + x, 0) / around.length;
    return own === null || around.length < 3 || mean <= 0 ? null : 100 * (own / mean - 1);
  });
}

export const isKnown = (column: Column | undefined): column is Column =>
  column?.some((value) => value !== null) === true;
