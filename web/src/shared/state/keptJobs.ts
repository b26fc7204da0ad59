/** What the page keeps: of jobs the front of the queue, of both what runs, and of the others the last ones told of. */

import type { Capture, Reconstruction } from "../api/types";

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

/** Captures that have ended and are kept; the table of all captures has its own. */
export const FINISHED = 500;

export const isFinished = (capture: Capture): boolean => capture.state === "complete" || capture.state === "failed";

/** More than these before some are dropped, so that it is not done at each message. */
const SLACK = 100;

/** Ids of the ended captures that are too many: the ones with the least `worth`. */
export function tooManyCaptures(captures: Record<string, Capture>, worth: (one: Capture) => number): Set<string> {
  const ended = Object.values(captures).filter(isFinished);
  return new Set(ended.length <= FINISHED + SLACK ? [] : beyond(FINISHED, ended, worth));
}

/** Ids of those behind the front, and of the ended ones, that are too many: the ones with the least `worth`. */
export function tooMany(jobs: Record<string, Reconstruction>, worth: (job: Reconstruction) => number): Set<string> {
  const all = Object.values(jobs);
  return new Set([...beyond(BEHIND, all.filter(isBehind), worth), ...beyond(ENDED, all.filter(isEnded), worth)]);
}

function beyond<T extends { id: string }>(most: number, all: T[], worth: (one: T) => number): string[] {
  if (all.length <= most) return [];
  const worths = new Map(all.map((one) => [one.id, worth(one)]));
  all.sort((a, b) => (worths.get(b.id) ?? 0) - (worths.get(a.id) ?? 0));
  return all.slice(most).map((one) => one.id);
}
