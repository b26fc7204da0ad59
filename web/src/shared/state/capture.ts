/** Texts for captures and jobs. */

import type { Capture, Reconstruction } from "../api/types";
import { count, duration, percent, when } from "./format";

/** The source without folders and options, which are in the tooltip. */
export const sourceOf = (capture: Capture): string =>
  capture.origin === "upload" ? "uploaded" : capture.source.replace(/\?.*$/, "").replace(/^(\w+:).*\//, "$1");

/** What a capture without a name is called: its source, and when it began. */
const unnamed = (capture: Capture): string => `${sourceOf(capture)}, ${when(capture.started_at)}`;

export const nameOf = (capture: Capture): string => (capture.name === "" ? unnamed(capture) : capture.name);

/** The number of a reconstruction among those of its capture, the first one first; `all` has its newest `of` many. */
export function numberOf(job: Reconstruction, all: Iterable<Reconstruction>, of: number): string {
  let [known, newer] = [0, 0];
  for (const one of all) {
    if (one.capture_id !== job.capture_id) continue;
    known += 1;
    if (one.id > job.id) newer += 1;
  }
  return `#${Math.max(of, known) - newer}`;
}

/** The name of a reconstruction, else when it was begun. */
export const calledOf = (job: Reconstruction): string => (job.name === "" ? when(job.created_at) : job.name);

/** Frames received and lost since the capture began; null before there are counters. */
export const framesSoFar = ({ counters }: Capture): number | null =>
  counters === null ? null : Object.values(counters.lost).reduce((sum, lost) => sum + lost, counters.received);

export function lengthOf(capture: Capture): string {
  const frames = capture.recording?.frames ?? framesSoFar(capture) ?? capture.frames_planned;
  if (frames == null) return "–";
  return capture.sensor === null ? `${count(frames)} frames` : duration(frames / capture.sensor.frame_rate_hz);
}

/** Progress, or place in the queue; empty for ended reconstructions. */
export function progressText(job: Reconstruction): string {
  const left = job.eta_s === null ? "" : `, about ${duration(job.eta_s)} left`;
  if (job.state === "queued" && job.held && job.progress > 0)
    return `paused at ${percent(job.progress)}: it goes on from there when it is let go`;
  if (job.state === "queued" && job.held) return "held: others go before it until it is let go";
  if (job.state === "queued")
    return `${job.queue_place === null ? "waiting" : `place ${job.queue_place} in the queue`}${left}`;
  if (job.state !== "running") return "";
  return `${percent(job.progress)}${left}`;
}
