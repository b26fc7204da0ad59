/** The timeline of a reconstruction, as fine as the part of it that is shown needs. */

import { useEffect, useState } from "react";

import { timeline as askTimeline } from "../../shared/api/calls";
import type { Timeline } from "../../shared/api/types";
import type { Span } from "./timelineWindow";

/** Most points that are fetched: about one for each pixel of a wide window. */
const POINTS = 1500;
/** Wait for the end of a gesture before the part that it leads to is fetched. */
const REST_MS = 150;

/**
 * The whole timeline, coarsely, and the shown part of it; fetched again with every version. The part is null while the
 * whole is shown; until it has come, the whole takes its place.
 */
export function useTimeline(
  jobId: string,
  version: number,
  shown: Span | null,
  rateHz: number | null,
): { whole: Timeline | null; part: Timeline | null } {
  const whole = useLatest(jobId, version === 0 ? null : `${version}`, () => askTimeline(jobId, { points: POINTS }));
  const rested = useRested(shown);
  const wanted = rested !== null && rateHz !== null && version > 0;
  const part = useLatest(jobId, wanted ? `${version} ${rested.first} ${rested.last}` : null, () => {
    const { first, last } = rested ?? { first: 0, last: 0 };
    const margin = (last - first) / 20;
    const rate = rateHz ?? 1;
    return askTimeline(jobId, {
      points: POINTS,
      from_s: Math.max(0, (first - margin) / rate),
      to_s: (last + margin) / rate,
    });
  });
  return { whole, part: shown === null ? null : part };
}

/** The value for the newest key of an owner that has come; asked for whenever the key changes. */
function useLatest<T>(owner: string, key: string | null, ask: () => Promise<T>): T | null {
  const [latest, setLatest] = useState<{ owner: string; value: T } | null>(null);
  useEffect(() => {
    if (key === null) return;
    let current = true;
    ask().then(
      (value) => current && setLatest({ owner, value }),
      () => undefined, // asked again with the next version
    );
    return () => {
      current = false;
    };
    // `ask` is a new function at every rendering; `owner` and `key` identify the request.
    // eslint-disable-next-line react-hooks/exhaustive-deps
  }, [owner, key]);
  return latest?.owner === owner ? latest.value : null;
}

function useRested(shown: Span | null): Span | null {
  const [rested, setRested] = useState(shown);
  useEffect(() => {
    const timer = setTimeout(() => setRested(shown), REST_MS);
    return () => clearTimeout(timer);
  }, [shown]);
  return rested;
}
