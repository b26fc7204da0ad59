/** Fetches the newest version of a scene whenever there is one, one at a time, and gives it to the viewer. */

import { useEffect, useRef, useState } from "react";

import { address, fetched } from "../api/calls";
import type { Reconstruction } from "../api/types";
import { useService, wordsOf } from "../state/store";
import type { Viewer } from "./Viewer";

/** Splats of a preview: what a phone can take every two seconds. */
export const PREVIEW_SPLATS = 60_000;

export interface Shown {
  version: number;
  splats: number;
  /** Whether all splats are on show, not a sample. */
  whole: boolean;
}

export function useScene(
  viewer: Viewer | null,
  job: Reconstruction | null,
  full: boolean,
): { shown: Shown | null; loading: boolean; problem: string | null } {
  const announced = useService((state) => (job === null ? undefined : state.scenes[job.id]?.version));
  const version = Math.max(job?.version ?? 0, announced ?? 0);
  const [state, setState] = useState<{ job: string; shown: Shown | null; problem: string | null } | null>(null);
  const [loading, setLoading] = useState(false);
  const wanted = useRef({ version: 0, full: false, total: 0 });
  const id = job?.id ?? null;
  const total = job?.splats ?? 0;

  useEffect(() => {
    wanted.current = { version, full, total };
  }, [version, full, total]);

  useEffect(() => {
    if (viewer === null || id === null) return;
    const ended = new AbortController();
    let shown: Shown | null = null;
    let busy = false;
    viewer.clear();
    const step = async (): Promise<void> => {
      const want = wanted.current;
      const whole = want.full || want.total <= PREVIEW_SPLATS;
      if (busy || want.version === 0 || (shown !== null && shown.version >= want.version && (shown.whole || !whole)))
        return;
      busy = true;
      setLoading(true);
      try {
        // Of an older version only the newest files are kept, so the newest is asked for whatever its number is by now.
        const format = whole ? "ply" : "spz";
        const url = address.scene(id, format, whole ? {} : { max_splats: PREVIEW_SPLATS });
        const bytes = new Uint8Array(await (await fetched(url, ended.signal)).arrayBuffer());
        await viewer.setScene(bytes, format, want.version);
        shown = { version: want.version, splats: viewer.splats, whole };
        setState({ job: id, shown, problem: null });
      } catch (error) {
        if (!ended.signal.aborted) setState({ job: id, shown, problem: wordsOf(error) });
      }
      busy = false;
      if (!ended.signal.aborted) setLoading(false);
    };
    void step();
    const timer = setInterval(() => void step(), 200);
    return () => {
      ended.abort();
      clearInterval(timer);
      setLoading(false);
    };
  }, [viewer, id]);

  const mine = state !== null && state.job === id ? state : null;
  return { shown: mine?.shown ?? null, problem: mine?.problem ?? null, loading };
}
