/** A capture in words. */

import type { Capture } from "../api/types";
import { count, duration } from "./format";

/** Where it came from, without folders and options: those are in the tooltip. */
export const sourceOf = (capture: Capture): string =>
  capture.origin === "upload" ? "uploaded" : capture.source.replace(/\?.*$/, "").replace(/^(\w+:).*\//, "$1");

export const nameOf = (capture: Capture): string => (capture.name === "" ? sourceOf(capture) : capture.name);

export function lengthOf(capture: Capture): string {
  const frames = capture.recording?.frames ?? capture.counters?.next_frame ?? capture.frames_planned;
  if (frames == null) return "–";
  return capture.sensor === null ? `${count(frames)} frames` : duration(frames / capture.sensor.frame_rate_hz);
}
