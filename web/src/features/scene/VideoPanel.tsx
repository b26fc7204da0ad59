/** Videos that the server makes: of the scene along a path, or of the recording in slow motion. */

import { type JSX, useState } from "react";

import { address } from "../../shared/api/calls";
import type { Capture, Reconstruction, Sensor } from "../../shared/api/types";
import { type Kind, KINDS } from "../../shared/state/videos";
import {
  factorOf,
  FpsField,
  NumberField,
  PaceFields,
  SlowMotion,
  usePace,
  VideoLink,
} from "../../shared/ui/SlowMotion";
import { poseOfView } from "./axes";
import type { Bookmark } from "./bookmarks";
import type { Path } from "./path";

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
  const pace = usePace();
  const [between, setBetween] = useState("3");
  // Those of another reconstruction have a unit of length of their own.
  const marks = bookmarks.filter((one) => one.reconstruction === job.id);
  const pathS = path === null ? 0 : (path.times.at(-1) ?? 0) - (path.times[0] ?? 0);
  const seconds = kind === "bookmarks" ? Number(between) * (marks.length - 1) : pathS * factorOf(pace, pathS);
  const through = marks.map((one) => poseOfView(one.camera)).map((one) => [...one.position, ...one.quaternion_wxyz]);
  return (
    <>
      <label className="wide">
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
      {kind === "recording" ? (
        <SlowMotion capture={capture} pace={pace} />
      ) : (
        <>
          <div className="row">
            <NumberField label="Width" value={width} onValue={setWidth} least={16} most={8192} />
            <NumberField label="Height" value={height} onValue={setHeight} least={16} most={8192} />
          </div>
          {kind === "bookmarks" ? (
            <>
              <FpsField pace={pace} />
              <NumberField
                label="Seconds from each to the next"
                value={between}
                onValue={setBetween}
                least={0.1}
                most={60}
              />
            </>
          ) : (
            <PaceFields pace={pace} takenS={pathS} />
          )}
          <VideoLink
            href={address.video(job.id, {
              version,
              seconds,
              fps: pace.fps,
              width,
              height,
              along: kind === "recorded" ? "recorded" : "smooth",
              through: kind === "bookmarks" ? through : [],
            })}
            seconds={seconds}
            fps={pace.fps}
            problem={
              kind === "bookmarks" && marks.length < 2
                ? "Save two or more bookmarks of this reconstruction first."
                : null
            }
          />
        </>
      )}
    </>
  );
}
