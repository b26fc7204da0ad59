/** The reconstruction of each listed capture, fetched for all of them together and kept with the list. */

import { useEffect, useRef, useState } from "react";
import { useShallow } from "zustand/react/shallow";

import * as calls from "../../shared/api/calls";
import type { Capture, Reconstruction } from "../../shared/api/types";
import { newestReconstruction, shownOf, useService } from "../../shared/state/store";

/** Captures that are asked about at once. */
const AT_ONCE = 100;

/** What gives the reconstruction of a capture whose scene is shown: as it is now if the store knows it. */
export function useShownJobs(captures: Capture[]): (captureId: string) => Reconstruction | null {
  const [fetched, setFetched] = useState<Record<string, Reconstruction>>({});
  // Jobs of other captures change all the time: the list is drawn anew only for its own.
  const shown = useService(
    useShallow(({ reconstructions }) => captures.map((one) => now(reconstructions, one.id, fetched[one.id]))),
  );
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
  const byCapture = new Map(captures.map((one, at) => [one.id, shown[at] ?? null]));
  return (captureId) => byCapture.get(captureId) ?? null;
}

/** The one that is shown of a capture, as it is now; `fetched` may have been forgotten by the store since. */
function now(
  known: Record<string, Reconstruction>,
  captureId: string,
  fetched: Reconstruction | undefined,
): Reconstruction | null {
  const own = newestReconstruction(known, captureId);
  if (fetched === undefined) return own;
  const same = known[fetched.id] ?? fetched;
  return own === null ? same : shownOf(own, same);
}
