/** One pixel of a capture that has ended: when it fired, and what the scene has there. */

import { type JSX, useEffect, useState } from "react";

import { point as askPoint, spikes as askSpikes } from "../../shared/api/calls";
import { ApiError } from "../../shared/api/http";
import type { ScenePoint, Spikes } from "../../shared/api/types";
import { count, percent } from "../../shared/state/format";
import { isNothing, PATIENT_MS, SETTLED_MS } from "./asking";
import { intervals } from "./region";

/** The answer about a pixel, that of the moment before until the next has come; "none" if there is none, null before any. */
function useAnswer<T>(pixel: string, frame: number | null, ask: (frame: number) => Promise<T>): T | "none" | null {
  const [got, setGot] = useState<{ pixel: string; answer: T | "none" } | null>(null);
  useEffect(() => {
    if (frame === null) return;
    let timer: ReturnType<typeof setTimeout>;
    let current = true;
    const again = (): void => {
      ask(frame).then(
        (answer) => current && setGot({ pixel, answer }),
        (error: unknown) => {
          if (!current) return;
          if (error instanceof ApiError && isNothing(error.status)) setGot({ pixel, answer: "none" });
          else timer = setTimeout(again, PATIENT_MS);
        },
      );
    };
    timer = setTimeout(again, SETTLED_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- pixel and frame say what is asked
  }, [pixel, frame]);
  return got?.pixel === pixel ? got.answer : null;
}

export function PixelProbe({
  capture,
  x,
  y,
  frame,
  rateHz,
}: {
  capture: string;
  x: number;
  y: number;
  /** The one that is shown; null before it is known. */
  frame: number | null;
  rateHz: number;
}): JSX.Element {
  const pixel = `${capture} ${x} ${y}`;
  const spikes = useAnswer(pixel, frame, (at) => askSpikes(capture, x, y, at));
  const point = useAnswer(pixel, frame, (at) => askPoint(capture, x, y, at));
  return (
    <>
      {spikes === "none" && <p className="dim">Its spikes at this moment are not recorded.</p>}
      {spikes !== null && spikes !== "none" && <SpikeTrain x={x} y={y} rateHz={rateHz} found={spikes} />}
      {point !== null && point !== "none" && <p>{depthOf(point)}</p>}
      {point === "none" && <p className="dim">No scene has this moment: its depth is not known.</p>}
    </>
  );
}

function depthOf({ depth, depth_m, opacity, version }: ScenePoint): JSX.Element {
  const length = depth_m === null ? `${depth?.toFixed(3) ?? ""} units` : `${depth_m.toFixed(3)} m`;
  return (
    <>
      <b>{depth === null ? "Nothing here" : `${length} deep`}</b>
      {`, ${percent(opacity)} opaque`}
      <span className="dim"> in version {count(version)} of the scene</span>
    </>
  );
}

function SpikeTrain({ x, y, rateHz, found }: { x: number; y: number; rateHz: number; found: Spikes }): JSX.Element {
  const { first_frame: first, frames, spikes } = found;
  const between = intervals(spikes);
  const ms = ((1000 * frames) / rateHz).toFixed(1);
  return (
    <figure className="spikes">
      <svg
        viewBox={`0 0 ${frames} 10`}
        preserveAspectRatio="none"
        role="img"
        aria-label={`Spikes of pixel ${x}, ${y} over ${frames} frames`}
      >
        {spikes.map((frame) => (
          <line key={frame} x1={frame - first + 0.5} x2={frame - first + 0.5} y1={0} y2={10} />
        ))}
      </svg>
      <figcaption className="dim">
        {count(spikes.length)} spikes in {count(frames)} frames from frame {count(first)}, {ms} ms
        {between !== null && `; ${between.mean.toFixed(1)} ± ${between.deviation.toFixed(1)} frames apart`}
      </figcaption>
    </figure>
  );
}
