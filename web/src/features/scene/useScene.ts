/** Fetches a version of a scene, and then what changes with each newer one, one at a time, for the viewer. */

import { useEffect, useRef, useState } from "react";

import { address, fetched } from "../../shared/api/calls";
import type { Reconstruction, Version } from "../../shared/api/types";
import { useService, errorText } from "../../shared/state/store";
import { readChanges } from "./changes";
import type { Viewer } from "./Viewer";

/** Most splats that are shown unless all are asked for; of more, a quarter is, twice as large. */
const MOST_SPLATS = 250_000;
/** Scenes of more splats are shown coarsely first. */
const COARSE_FIRST = 30_000;
/** Wait after a request that failed; doubled with each, ms. */
const [FIRST_WAIT_MS, LONGEST_WAIT_MS] = [200, 10_000];
/** Levels of detail: a sixteenth of the splats, a quarter, all. */
const [COARSE, QUARTER, ALL] = [0, 1, 2];

export interface Shown {
  version: number;
  splats: number;
  /** Whether all splats are shown, not a sample. */
  whole: boolean;
}

export function useScene(
  viewer: Viewer | null,
  job: Reconstruction | null,
  full: boolean,
  pinned: Version | null,
): { shown: Shown | null; loading: boolean; problem: string | null } {
  const announced = useService((state) => (job === null ? undefined : state.scenes[job.id]?.version));
  const version = pinned?.version ?? Math.max(job?.version ?? 0, announced ?? 0);
  const [state, setState] = useState<{
    job: string;
    only: number | undefined;
    shown: Shown | null;
    problem: string | null;
  } | null>(null);
  const [loading, setLoading] = useState(false);
  const cleared = useRef<{ viewer: Viewer; id: string } | null>(null);
  const wanted = useRef({ version: 0, full: false, total: 0 });
  const id = job?.id ?? null;
  const total = pinned?.splats ?? job?.splats ?? 0;
  const only = pinned?.version;

  useEffect(() => {
    wanted.current = { version, full, total };
  }, [version, full, total]);

  useEffect(() => {
    if (viewer === null || id === null) return;
    const ended = new AbortController();
    let shown: (Shown & { level: number }) | null = null;
    let since: string | null = null;
    let busy = false;
    let waitMs = FIRST_WAIT_MS;
    let nextMs = 0;
    // A version takes the place of another of its reconstruction, and the view stays.
    if (cleared.current?.viewer !== viewer || cleared.current.id !== id) viewer.clear();
    cleared.current = { viewer, id };
    const step = async (): Promise<void> => {
      const want = wanted.current;
      const finest = want.full || want.total <= MOST_SPLATS ? ALL : QUARTER;
      if (performance.now() < nextMs) return;
      if (busy || want.version === 0 || (shown !== null && shown.version >= want.version && shown.level >= finest))
        return;
      busy = true;
      setLoading(true);
      try {
        const level = shown === null && viewer.splats === 0 && want.total > COARSE_FIRST ? COARSE : finest;
        if (level !== shown?.level) since = null;
        // Of an older version only the newest files are kept, so the newest is fetched, whatever its number.
        const url = address.changes(id, { level, version: only, since: since ?? undefined });
        const changes = readChanges(await (await fetched(url, ended.signal)).arrayBuffer());
        if (!ended.signal.aborted && (await viewer.change(changes))) {
          since = changes.state;
          const version = Math.max(changes.version, want.version);
          shown = { version, splats: viewer.splats, whole: level === ALL, level };
          setState({ job: id, only, shown, problem: null });
        }
        waitMs = FIRST_WAIT_MS;
      } catch (error) {
        nextMs = performance.now() + waitMs;
        waitMs = Math.min(2 * waitMs, LONGEST_WAIT_MS);
        if (!ended.signal.aborted) setState({ job: id, only, shown, problem: errorText(error) });
      }
      busy = false;
      if (ended.signal.aborted) return;
      setLoading(false);
      if (shown?.level === COARSE) void step();
    };
    void step();
    const timer = setInterval(() => void step(), 200);
    return () => {
      ended.abort();
      clearInterval(timer);
      setLoading(false);
    };
  }, [viewer, id, only]);

  const mine = state !== null && state.job === id && state.only === only ? state : null;
  return { shown: mine?.shown ?? null, problem: mine?.problem ?? null, loading };
}
