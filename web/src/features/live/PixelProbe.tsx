/** One pixel of a capture that has ended: when it fired, and what the scene has there. */

import { type JSX, useEffect, useState } from "react";

import { point as askPoint, spikes as askSpikes } from "../../shared/api/calls";
import type { ScenePoint, Spikes } from "../../shared/api/types";
import { count, percent } from "../../shared/state/format";
import { intervals } from "./region";

/** An answer about a pixel; null while it is asked for, "none" if there is none. */
function useAnswer<T>(key: string, ask: () => Promise<T>): T | "none" | null {
  const [got, setGot] = useState<{ key: string; answer: T | "none" } | null>(null);
  useEffect(() => {
    let current = true;
    ask().then(
      (answer) => current && setGot({ key, answer }),
      () => current && setGot({ key, answer: "none" }), // it was not recorded, lost, or has no scene
    );
    return () => {
      current = false;
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the key says what is asked
  }, [key]);
  return got?.key === key ? got.answer : null;
}

export function PixelProbe({
  capture,
  x,
  y,
  moment,
  rateHz,
}: {
  capture: string;
  x: number;
  y: number;
  /** Frame to look at; null: the middle of the recording. */
  moment: number | null;
  rateHz: number;
}): JSX.Element {
  const key = `${capture} ${x} ${y} ${moment ?? ""}`;
  const spikes = useAnswer(key, () => askSpikes(capture, x, y, moment));
  const middle = spikes === null || spikes === "none" ? null : spikes.first_frame + Math.floor(spikes.frames / 2);
  const frame = moment ?? middle;
  const point = useAnswer(`${key} ${frame ?? ""}`, () => askPoint(capture, x, y, frame));
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
