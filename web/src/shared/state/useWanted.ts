import { useEffect, useState } from "react";

import type { Capture, Reconstruction } from "../api/types";
import { errorText, loadCapture, loadReconstruction, loadReconstructions, useService } from "./store";

/** Keep a capture that the URL names: fetched if the store does not hold it, and after messages were missed. */
export function useWanted(id: string | null, known: Capture | null): string | null {
  const [problem, setProblem] = useState<{ id: string; text: string } | null>(null);
  const missing = id !== null && known === null;
  const knownId = known?.id ?? null;
  const refreshed = useService((state) => state.refreshed);
  useEffect(() => {
    if (missing) loadCapture(id).catch((error: unknown) => setProblem({ id, text: errorText(error) }));
  }, [id, missing]);
  useEffect(() => {
    // The banner at the top shows errors.
    if (knownId !== null) Promise.all([loadCapture(knownId), loadReconstructions(knownId)]).catch(() => undefined);
  }, [knownId, refreshed]);
  return missing && problem?.id === id ? problem.text : null;
}

/** A reconstruction by its id, fetched if the store does not hold it. */
export function useWantedReconstruction(id: string | null): { job: Reconstruction | null; problem: string | null } {
  const job = useService((state) => (id === null ? null : (state.reconstructions[id] ?? null)));
  const [problem, setProblem] = useState<{ id: string; text: string } | null>(null);
  const missing = id !== null && job === null;
  useEffect(() => {
    if (missing) loadReconstruction(id).catch((error: unknown) => setProblem({ id, text: errorText(error) }));
  }, [id, missing]);
  return { job, problem: missing && problem?.id === id ? problem.text : null };
}
