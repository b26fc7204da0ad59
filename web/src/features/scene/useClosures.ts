/** The closed loops of a reconstruction, and how many of them have been closed just now. */

import { useEffect, useState } from "react";

import { timeline } from "../../shared/api/calls";
import type { Closure } from "../../shared/api/types";

/** A new loop is highlighted for so long. */
const FRESH_MS = 5000;

export interface Closures {
  all: readonly Closure[];
  /** The last so many were closed a moment ago, while the page was looking. */
  fresh: number;
}

const NONE: Closures = { all: [], fresh: 0 };

/** Asked for again with every version. */
export function useClosures(jobId: string, version: number): Closures {
  const [found, setFound] = useState<{ jobId: string; closures: Closures } | null>(null);
  useEffect(() => {
    if (version === 0) return;
    let current = true;
    timeline(jobId, { points: 1 }).then(
      ({ closures: all }) => {
        if (!current) return;
        setFound((before) => {
          if (before?.jobId !== jobId) return { jobId, closures: { all, fresh: 0 } };
          const more = all.length - before.closures.all.length;
          return more === 0 ? before : { jobId, closures: { all, fresh: Math.max(more, 0) } };
        });
      },
      () => undefined, // asked again with the next version
    );
    return () => {
      current = false;
    };
  }, [jobId, version]);
  const closures = found?.jobId === jobId ? found.closures : NONE;
  useEffect(() => {
    if (closures.fresh === 0) return;
    const timer = setTimeout(() => setFound({ jobId, closures: { all: closures.all, fresh: 0 } }), FRESH_MS);
    return () => clearTimeout(timer);
  }, [jobId, closures]);
  return closures;
}
