/** The picture of a capture: the newest from the WebSocket if it carries this kind, otherwise from REST. */

import { useEffect, useState } from "react";

import { address } from "../../shared/api/calls";
import { reach } from "../../shared/api/http";
import type { Capture, PreviewKind } from "../../shared/api/types";
import { isFinished, useService } from "../../shared/state/store";
import { isNothing, PATIENT_MS } from "./asking";

export interface Picture {
  url: string;
  frame: number | null;
  /** Whether the service has applied the gain already. */
  gained: boolean;
}

const PERIOD_MS = 300;

/** Kinds sent over the WebSocket; others are rendered on request. */
const PUSHED: readonly PreviewKind[] = ["interval", "rate"];

/**
 * `moment`: the frame to show of a capture that has ended; null: its middle. Returns null where there is no picture, and
 * undefined until that is known.
 */
export function usePicture(
  capture: Capture | null,
  kind: PreviewKind,
  gain: number,
  moment: number | null,
): Picture | null | undefined {
  const pushed = useService((state) =>
    capture !== null && PUSHED.includes(kind) ? state.previews[capture.id]?.[kind] : undefined,
  );
  const [answered, setAnswered] = useState<{ key: string; over: boolean; picture: Picture | null } | null>(null);
  const id = capture?.id ?? null;
  const over = capture === null || isFinished(capture);
  const begun = over || (capture.counters?.received ?? 0) > 0;
  const served = pushed !== undefined && !over;
  // Live pictures are encoded once for all clients, so the page applies the gain.
  const gained = over || kind === "render";
  const servedGain = gained ? gain : 1;
  const shown = over && moment !== null ? moment : undefined;
  const key = `${id ?? ""} ${kind}`;

  useEffect(() => {
    if (id === null || served || !begun) return;
    let timer: ReturnType<typeof setTimeout> | undefined;
    let url: string | null = null;
    const ended = new AbortController();
    const ask = async (): Promise<void> => {
      let wait = PERIOD_MS;
      try {
        const wanted = { gain: servedGain === 1 ? undefined : servedGain, frame: shown };
        const response = await reach(address.preview(id, kind, wanted), { signal: ended.signal });
        if (response.ok) {
          const next = URL.createObjectURL(await response.blob());
          const frame = response.headers.get("X-Frame");
          setAnswered({ key, over, picture: { url: next, frame: frame === null ? null : Number(frame), gained } });
          if (url !== null) URL.revokeObjectURL(url);
          url = next;
        } else {
          if (over && isNothing(response.status)) setAnswered({ key, over, picture: null });
          wait = PATIENT_MS;
        }
      } catch {
        wait = PATIENT_MS; // not available yet, or no connection: shown by the banner at the top
      }
      if (!ended.signal.aborted && !(over && url !== null)) timer = setTimeout(() => void ask(), wait);
    };
    void ask();
    return () => {
      ended.abort();
      clearTimeout(timer);
      // The shown picture keeps its URL until the next one has arrived.
      if (url !== null) setTimeout(() => URL.revokeObjectURL(url ?? ""), 2000);
    };
  }, [id, kind, key, shown, servedGain, gained, over, served, begun]);

  // Until the first stored picture has come, the last live one stays.
  const fresh = answered?.key === key && (answered.over === over || pushed === undefined);
  if (!served && fresh) return answered.picture;
  if (pushed === undefined) return undefined;
  return { url: `data:image/webp;base64,${pushed.image}`, frame: pushed.frame, gained: false };
}
