/** A capture in words. */

import type { Capture } from "../api/types";
import { count, duration } from "./format";

export const nameOf = (capture: Capture): string => (capture.name === "" ? capture.source : capture.name);

export function lengthOf(capture: Capture): string {
  const frames = capture.recording?.frames ?? capture.counters?.next_frame ?? capture.frames_planned;
  if (frames == null) return "–";
  return capture.sensor === null ? `${count(frames)} frames` : duration(frames / capture.sensor.frame_rate_hz);
}
