/** The kept versions of a reconstruction, fetched again when there is a new one. */

import { useEffect } from "react";

import { versions } from "../../shared/api/calls";
import type { Reconstruction, Version } from "../../shared/api/types";
import { useFetch } from "../../shared/state/useFetch";

const NONE: readonly Version[] = [];

export function useVersions(job: Reconstruction | null): readonly Version[] {
  const id = job?.id ?? null;
  const newest = job?.version ?? 0;
  const { value, again } = useFetch(id, () => (id === null ? Promise.resolve([]) : versions(id)));
  useEffect(again, [again, newest]);
  return value ?? NONE;
}
