/** A video of a recording in slow motion, and the fields that videos are chosen by. */

import { type JSX, useState } from "react";

import { address } from "../api/calls";
import type { Capture } from "../api/types";
import { count, duration } from "../state/format";
import { problemOf, slownessFor } from "../state/videos";
import { DownloadLink } from "./DownloadLink";

export interface Pace {
  fps: string;
  onFps: (fps: string) => void;
  /** How many times slower; null: so that it takes about ten seconds. */
  slower: string | null;
  onSlower: (slower: string) => void;
}

export function usePace(): Pace {
  const [fps, onFps] = useState("30");
  const [slower, onSlower] = useState<string | null>(null);
  return { fps, onFps, slower, onSlower };
}

/** How many times slower a time is shown. */
export const factorOf = ({ slower }: Pace, takenS: number): number =>
  slower === null ? slownessFor(takenS) : Number(slower);

export function SlowMotion({ capture, pace }: { capture: Capture; pace: Pace }): JSX.Element {
  const [window, setWindow] = useState("16");
  const [compensate, setCompensate] = useState(false);
  const { fps } = pace;
  const recordedS = capture.sensor === null ? 0 : (capture.recording?.frames ?? 0) / capture.sensor.frame_rate_hz;
  const slower = factorOf(pace, recordedS);
  const seconds = recordedS * slower;
  return (
    <>
      <PaceFields pace={pace} takenS={recordedS} />
      <NumberField label="Frames of a picture" value={window} onValue={setWindow} least={1} most={4096} />
      <label className="check">
        <input type="checkbox" checked={compensate} onChange={(event) => setCompensate(event.currentTarget.checked)} />
        Less noise: neighbouring pictures, moved along the motion, are added
      </label>
      <VideoLink
        href={address.slowMotion(capture.id, { slower, fps, window, compensate })}
        seconds={seconds}
        fps={fps}
        problem={recordedS === 0 ? "The recording is not closed yet, or is gone." : null}
      />
    </>
  );
}

export function PaceFields({ pace, takenS }: { pace: Pace; takenS: number }): JSX.Element {
  return (
    <>
      <FpsField pace={pace} />
      <NumberField
        label="Times slower"
        value={`${pace.slower ?? factorOf(pace, takenS)}`}
        onValue={pace.onSlower}
        least={0.001}
        most={1e6}
      />
    </>
  );
}

export const FpsField = ({ pace }: { pace: Pace }): JSX.Element => (
  <NumberField label="Pictures a second" value={pace.fps} onValue={pace.onFps} least={1} most={240} />
);

/** The download of a video, or why there can be none. */
export function VideoLink({
  href,
  seconds,
  fps,
  problem,
}: {
  href: string;
  seconds: number;
  fps: string;
  /** What is wrong besides the length. */
  problem: string | null;
}): JSX.Element {
  const wrong = problem ?? problemOf(seconds, Number(fps));
  if (wrong !== null)
    return (
      <p className="note" role="status">
        {wrong}
      </p>
    );
  return (
    <>
      <DownloadLink href={href}>Video, {duration(seconds)}</DownloadLink>
      <p className="dim hint">
        {count(Math.max(1, Math.round(seconds * Number(fps))))} pictures. The server makes it when you ask, which takes
        about as long as the video, longer for large pictures.
      </p>
    </>
  );
}

export function NumberField({
  label,
  value,
  onValue,
  least,
  most,
}: {
  label: string;
  value: string;
  onValue: (value: string) => void;
  least: number;
  most: number;
}): JSX.Element {
  return (
    <label className="row">
      <span className="dim">{label}</span>
      <input
        type="number"
        step="any"
        min={least}
        max={most}
        value={value}
        onChange={(event) => onValue(event.target.value)}
      />
    </label>
  );
}
