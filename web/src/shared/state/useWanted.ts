import { useEffect, useState } from "react";

import { capture as askCapture } from "../api/calls";
import type { Capture } from "../api/types";
import { errorText, loadReconstructions, storeCapture } from "./store";

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
