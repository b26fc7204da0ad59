/** Videos that the server makes: of the scene along a path, or of the recording in slow motion. */

import { type JSX, useState } from "react";

import { address } from "../../shared/api/calls";
import type { Capture, Reconstruction, Sensor } from "../../shared/api/types";
import { count, duration } from "../../shared/state/format";
import { DownloadLink } from "../../shared/ui/DownloadLink";
import { poseOfView } from "./axes";
import type { Bookmark } from "./bookmarks";
import type { Path } from "./path";
import { type Kind, KINDS, problemOf, slownessFor } from "./videos";

export interface VideoProps {
  capture: Capture;
  job: Reconstruction;
  /** The version that is shown; null: the newest. */
  version: number | null;
  sensor: Sensor | null;
  path: Path | null;
  bookmarks: readonly Bookmark[];
}

export function VideoPanel(props: VideoProps): JSX.Element {
  const [open, setOpen] = useState(false);
  return (
    <details className="tool" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Video</summary>
      {open && <Making {...props} />}
    </details>
  );
}

function Making({ capture, job, version, sensor, path, bookmarks }: VideoProps): JSX.Element {
  const [kind, setKind] = useState<Kind>("smooth");
  const [width, setWidth] = useState(`${sensor?.width ?? 1280}`);
  const [height, setHeight] = useState(`${sensor?.height ?? 720}`);
  const [fps, setFps] = useState("30");
  const [slower, setSlower] = useState<string | null>(null);
  const [between, setBetween] = useState("3");
  const [window, setWindow] = useState("16");
  const [compensate, setCompensate] = useState(false);
  // Those of another reconstruction have a unit of length of their own.
  const marks = bookmarks.filter((one) => one.reconstruction === job.id);
  const pathS = path === null ? 0 : (path.times.at(-1) ?? 0) - (path.times[0] ?? 0);
  const recordedS = sensor === null ? 0 : (capture.recording?.frames ?? 0) / sensor.frame_rate_hz;
  const takenS = kind === "recording" ? recordedS : pathS;
  const factor = slower === null ? slownessFor(takenS) : Number(slower);
  const seconds = kind === "bookmarks" ? Number(between) * (marks.length - 1) : takenS * factor;
  const problem =
    kind === "bookmarks" && marks.length < 2
      ? "Save two or more bookmarks of this reconstruction first."
      : kind === "recording" && recordedS === 0
        ? "The recording is not closed yet, or is gone."
        : problemOf(seconds, Number(fps));
  const through = marks.map((one) => poseOfView(one.camera)).map((one) => [...one.position, ...one.quaternion_wxyz]);
  const href =
    kind === "recording"
      ? address.slowMotion(capture.id, { slower: factor, fps, window, compensate })
      : address.video(job.id, {
          version,
          seconds,
          fps,
          width,
          height,
          along: kind === "recorded" ? "recorded" : "smooth",
          through: kind === "bookmarks" ? through : [],
        });
  return (
    <>
      <label className="row">
        <span className="dim">Of</span>
        <select aria-label="Video of" value={kind} onChange={(event) => setKind(event.target.value as Kind)}>
          {KINDS.map((one) => (
            <option key={one.value} value={one.value}>
              {one.label}
            </option>
          ))}
        </select>
      </label>
      <p className="dim hint">{KINDS.find((one) => one.value === kind)?.hint}</p>
      {kind !== "recording" && (
        <div className="row">
          <NumberField label="Width" value={width} onValue={setWidth} least={16} most={8192} />
          <NumberField label="Height" value={height} onValue={setHeight} least={16} most={8192} />
        </div>
      )}
      <NumberField label="Pictures a second" value={fps} onValue={setFps} least={1} most={240} />
      {kind === "bookmarks" ? (
        <NumberField label="Seconds from each to the next" value={between} onValue={setBetween} least={0.1} most={60} />
      ) : (
        <NumberField label="Times slower" value={slower ?? `${factor}`} onValue={setSlower} least={0.001} most={1e6} />
      )}
      {kind === "recording" && (
        <>
          <NumberField label="Frames of a picture" value={window} onValue={setWindow} least={1} most={4096} />
          <label className="check">
            <input
              type="checkbox"
              checked={compensate}
              onChange={(event) => setCompensate(event.currentTarget.checked)}
            />
            Less noise: neighbouring pictures, moved along the motion, are added
          </label>
        </>
      )}
      {problem === null ? (
        <>
          <DownloadLink href={href}>Video, {duration(seconds)}</DownloadLink>
          <p className="dim hint">
            {count(Math.max(1, Math.round(seconds * Number(fps))))} pictures. The server makes it when you ask, which
            takes about as long as the video, longer for large pictures.
          </p>
        </>
      ) : (
        <p className="note" role="status">
          {problem}
        </p>
      )}
    </>
  );
}

function NumberField({
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
