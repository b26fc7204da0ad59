/** Fetches a version of a scene, or the newest whenever there is one, one at a time, and gives it to the viewer. */

import { useEffect, useRef, useState } from "react";

import { address, fetched } from "../../shared/api/calls";
import type { Reconstruction, Version } from "../../shared/api/types";
import { useService, errorText } from "../../shared/state/store";
import type { Viewer } from "./Viewer";

/** Splats of a preview: a phone can load this many every two seconds. */
export const PREVIEW_SPLATS = 60_000;

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
    let shown: Shown | null = null;
    let busy = false;
    // A version takes the place of another of its reconstruction, and the view stays.
    if (cleared.current?.viewer !== viewer || cleared.current.id !== id) viewer.clear();
    cleared.current = { viewer, id };
    const step = async (): Promise<void> => {
      const want = wanted.current;
      const whole = want.full || want.total <= PREVIEW_SPLATS;
      if (busy || want.version === 0 || (shown !== null && shown.version >= want.version && (shown.whole || !whole)))
        return;
      busy = true;
      setLoading(true);
      try {
        // Of an older version only the newest files are kept, so the newest is fetched, whatever its number.
        const format = whole ? "ply" : "spz";
        const url = address.scene(
          id,
          format,
          whole ? { version: only } : { version: only, max_splats: PREVIEW_SPLATS },
        );
        const bytes = new Uint8Array(await (await fetched(url, ended.signal)).arrayBuffer());
        await viewer.setScene(bytes, format, want.version);
        shown = { version: want.version, splats: viewer.splats, whole };
        setState({ job: id, only, shown, problem: null });
      } catch (error) {
        if (!ended.signal.aborted) setState({ job: id, only, shown, problem: errorText(error) });
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
  }, [viewer, id, only]);

  const mine = state !== null && state.job === id && state.only === only ? state : null;
  return { shown: mine?.shown ?? null, problem: mine?.problem ?? null, loading };
}
