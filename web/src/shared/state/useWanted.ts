import { useEffect, useState } from "react";

import { capture as askCapture, reconstruction as askReconstruction } from "../api/calls";
import type { Capture, Reconstruction } from "../api/types";
import { errorText, loadReconstructions, storeCapture, storeReconstruction, useService } from "./store";

/** Fetch a capture that the URL names and the store does not hold. */
export function useWanted(id: string | null, known: Capture | null): string | null {
  const [problem, setProblem] = useState<{ id: string; text: string } | null>(null);
  const missing = id !== null && known === null;
  const knownId = known?.id ?? null;
  useEffect(() => {
    if (missing) askCapture(id).then(storeCapture, (error: unknown) => setProblem({ id, text: errorText(error) }));
  }, [id, missing]);
  useEffect(() => {
    if (knownId !== null) loadReconstructions(knownId).catch(() => undefined); // shown by the banner at the top
  }, [knownId]);
  return missing && problem?.id === id ? problem.text : null;
}

/** A reconstruction by its id, fetched if the store does not hold it. */
export function useWantedReconstruction(id: string | null): { job: Reconstruction | null; problem: string | null } {
  const job = useService((state) => (id === null ? null : (state.reconstructions[id] ?? null)));
  const [problem, setProblem] = useState<{ id: string; text: string } | null>(null);
  const missing = id !== null && job === null;
  useEffect(() => {
    if (missing)
      askReconstruction(id).then(storeReconstruction, (error: unknown) => setProblem({ id, text: errorText(error) }));
  }, [id, missing]);
  return { job, problem: missing && problem?.id === id ? problem.text : null };
}
