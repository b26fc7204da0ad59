/** The part of a long queue that the page keeps: its front, and the jobs behind it that were told of last. */

import type { Reconstruction } from "../api/types";

/** Jobs of the queue that are listed; the service tells of every change of their places. */
export const FRONT = 100;
/** Jobs behind the front that are kept, for the pages of their captures. */
const BEHIND = 100;

/** Whether it waits behind the front, and has no scene that could be shown. */
export const isBehind = (job: Reconstruction): boolean =>
  job.state === "queued" && job.version === 0 && (job.queue_place ?? 0) > FRONT;

/** Ids of those behind the front that are too many: the ones with the least `worth`. */
export function tooMany(jobs: Record<string, Reconstruction>, worth: (job: Reconstruction) => number): Set<string> {
  const behind = Object.values(jobs).filter(isBehind);
  if (behind.length <= BEHIND) return new Set();
  behind.sort((a, b) => worth(b) - worth(a));
  return new Set(behind.slice(BEHIND).map((job) => job.id));
}
