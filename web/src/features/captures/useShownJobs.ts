/** The reconstruction of each listed capture, fetched for all of them together and kept with the list. */

import { useEffect, useRef, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Capture, Reconstruction } from "../../shared/api/types";
import { newestReconstruction, shownOf, useService } from "../../shared/state/store";

/** Captures that are asked about at once. */
const AT_ONCE = 100;

/** What gives the reconstruction of a capture whose scene is shown: as it is now if the store knows it. */
export function useShownJobs(captures: Capture[]): (captureId: string) => Reconstruction | null {
  const known = useService((state) => state.reconstructions);
  const [fetched, setFetched] = useState<Record<string, Reconstruction>>({});
  const asked = useRef(new Set<string>());
  useEffect(() => {
    const missing = captures.filter((one) => one.reconstruction_count > 0 && !asked.current.has(one.id));
    for (let at = 0; at < missing.length; at += AT_ONCE) {
      const ids = missing.slice(at, at + AT_ONCE).map((one) => one.id);
      for (const id of ids) asked.current.add(id);
      calls
        .shownOf(ids)
        .then((jobs) =>
          setFetched((old) => ({ ...old, ...Object.fromEntries(jobs.map((job) => [job.capture_id, job])) })),
        )
        .catch(() => ids.forEach((id) => asked.current.delete(id))); // shown by the banner at the top
    }
  }, [captures]);
  return (captureId) => {
    const own = newestReconstruction(known, captureId);
    const earlier = fetched[captureId];
    if (earlier === undefined) return own;
    const now = known[earlier.id] ?? earlier;
    return own === null ? now : shownOf(own, now);
  };
}
