/** Which reconstructions the page keeps: the front of the queue, those that run, and of the others the last ones told of. */

import type { Reconstruction } from "../api/types";

/** Jobs of the queue that are listed; the service tells of every change of their places. */
export const FRONT = 100;
/** Jobs behind the front that are kept, for the pages of their captures. */
const BEHIND = 100;
/** Ended jobs that are kept; of one capture no more are listed. */
export const ENDED = 1000;

export const isEnded = (job: Reconstruction): boolean => !["queued", "running"].includes(job.state);

/** Whether it waits behind the front, and has no scene that could be shown. */
export const isBehind = (job: Reconstruction): boolean =>
  job.state === "queued" && job.version === 0 && (job.queue_place ?? 0) > FRONT;

/** Ids of those behind the front, and of the ended ones, that are too many: the ones with the least `worth`. */
export function tooMany(jobs: Record<string, Reconstruction>, worth: (job: Reconstruction) => number): Set<string> {
  const all = Object.values(jobs);
  return new Set([...beyond(BEHIND, all.filter(isBehind), worth), ...beyond(ENDED, all.filter(isEnded), worth)]);
}

function beyond(most: number, jobs: Reconstruction[], worth: (job: Reconstruction) => number): string[] {
  if (jobs.length <= most) return [];
  const worths = new Map(jobs.map((job) => [job.id, worth(job)]));
  jobs.sort((a, b) => (worths.get(b.id) ?? 0) - (worths.get(a.id) ?? 0));
  return jobs.slice(most).map((job) => job.id);
}
