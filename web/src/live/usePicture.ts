/** The newest picture of a capture: from the socket when it brings this kind, from REST otherwise. */

import { useEffect, useState } from "react";

import { address } from "../api/calls";
import { reach } from "../api/http";
import type { Capture, PreviewKind } from "../api/types";
import { isOver, useService } from "../state/store";

export interface Picture {
  url: string;
  frame: number | null;
  /** Whether the service has applied the gain already. */
  gained: boolean;
}

const PERIOD_MS = 300;
const PATIENT_MS = 1500;

/** Pictures that the socket brings; the others are rendered by the service when they are asked for. */
const PUSHED: readonly PreviewKind[] = ["interval", "rate"];

export function usePicture(capture: Capture | null, kind: PreviewKind, gain: number): Picture | null {
  const pushed = useService((state) =>
    state.previewOf === capture?.id && PUSHED.includes(kind) ? state.previews[kind] : undefined,
  );
  const [asked, setAsked] = useState<(Picture & { key: string }) | null>(null);
  const id = capture?.id ?? null;
  const over = capture === null || isOver(capture);
  const begun = over || (capture.counters?.received ?? 0) > 0;
  const served = pushed !== undefined && !over;
  // Pictures of frames on their way are made once for everybody: their gain is the page's business.
  const gained = over || kind === "render";
  const askedGain = gained ? gain : 1;

  useEffect(() => {
    if (id === null || served || !begun) return;
    const key = `${id} ${kind}`;
    let timer: ReturnType<typeof setTimeout> | undefined;
    let url: string | null = null;
    const ended = new AbortController();
    const ask = async (): Promise<void> => {
      let wait = PERIOD_MS;
      try {
        const response = await reach(address.preview(id, kind, { gain: askedGain === 1 ? undefined : askedGain }), {
          signal: ended.signal,
        });
        if (response.ok) {
          const next = URL.createObjectURL(await response.blob());
          const frame = response.headers.get("X-Frame");
          setAsked({ key, url: next, frame: frame === null ? null : Number(frame), gained });
          if (url !== null) URL.revokeObjectURL(url);
          url = next;
        } else {
          wait = PATIENT_MS;
        }
      } catch {
        wait = PATIENT_MS; // not there yet or the service is away: the band at the top tells
      }
      if (!ended.signal.aborted && !(over && url !== null)) timer = setTimeout(() => void ask(), wait);
    };
    void ask();
    return () => {
      ended.abort();
      clearTimeout(timer);
      // The picture on show keeps its address until the next one has come.
      if (url !== null) setTimeout(() => URL.revokeObjectURL(url ?? ""), 2000);
    };
  }, [id, kind, askedGain, gained, over, served, begun]);

  if (served) return { url: `data:image/webp;base64,${pushed.image}`, frame: pushed.frame, gained: false };
  return asked !== null && asked.key === `${id ?? ""} ${kind}` ? asked : null;
}
