/** What is on show, and the ways to look at it. */

import { type JSX, useState } from "react";

import type { Capture, Reconstruction } from "../api/types";
import { nameOf } from "../state/capture";
import { count, decibel, percent } from "../state/format";
import { toast } from "../state/toasts";
import { Icon } from "../ui/icons";
import { JobBadge, Meter, Segmented, Stat, trackingHint } from "../ui/parts";
import { type Bookmark, readBookmarks, writeBookmarks } from "./bookmarks";
import { type Colouring, SPEED_COLOURS, STATE_COLOURS, STATES } from "./path";
import type { Shown } from "./useScene";
import type { Layers, Steering } from "./Viewer";

const LAYER_NAMES: Record<keyof Layers, string> = {
  splats: "Splats",
  path: "Path",
  frustum: "Frustum",
  grid: "Grid",
  axes: "Axes",
};
const STEERINGS = [
  { value: "orbit", label: "Orbit", hint: "Drag turns, right drag shifts, wheel approaches, arrow keys shift" },
  { value: "fly", label: "Fly", hint: "Click into the scene; W A S D R F move, Q E roll, drag looks around" },
] as const;
const COLOURINGS = [
  { value: "state", label: "State" },
  { value: "speed", label: "Speed" },
] as const;

export interface InspectorProps {
  capture: Capture;
  job: Reconstruction;
  shown: Shown | null;
  loading: boolean;
  full: boolean;
  onFull: () => void;
  layers: Layers;
  onLayers: (layers: Layers) => void;
  colouring: Colouring;
  onColouring: (colouring: Colouring) => void;
  steering: Steering;
  onSteering: (steering: Steering) => void;
  ride: boolean;
  onRide: (ride: boolean) => void;
  onHome: () => void;
  onScreenshot: () => void;
  currentView: () => { camera: number[]; frame: number | null };
  onView: (camera: number[], frame: number | null) => void;
}

export function Inspector(props: InspectorProps): JSX.Element {
  const { capture, job, shown } = props;
  const running = job.state === "running" || job.state === "queued";
  return (
    <aside className="inspector" aria-label="Scene settings">
      <header>
        <strong>{nameOf(capture)}</strong>
        <JobBadge job={job} />
      </header>
      <dl className="stats">
        <Stat name="Version">{shown?.version ?? "–"}</Stat>
        <Stat name="Splats shown" hint={`${count(job.splats)} in the scene`}>
          {shown === null ? "–" : count(shown.splats)}
        </Stat>
        <Stat name="Poses">{count(job.poses)}</Stat>
        <Stat name="PSNR">{decibel(job.psnr_db)}</Stat>
      </dl>
      {running && job.stage === "refining" && (
        <div className="refining">
          <Meter share={job.progress} label="Refinement" />
          <span>{percent(job.progress)} refined</span>
        </div>
      )}
      {shown !== null && !shown.whole && (
        <button type="button" disabled={props.full} onClick={props.onFull}>
          <Icon name="layers" /> {props.full ? "Loading all splats…" : `Show all ${count(job.splats)} splats`}
        </button>
      )}
      <div className="row">
        <Segmented label="Steering" value={props.steering} choices={STEERINGS} onChange={props.onSteering} />
        <button type="button" onClick={props.onHome} title="Back to the first view">
          <Icon name="home" /> Home
        </button>
      </div>
      <p className="dim hint">{STEERINGS.find((one) => one.value === props.steering)?.hint}</p>
      <button type="button" aria-pressed={props.ride} onClick={() => props.onRide(!props.ride)}>
        <Icon name="eye" /> Ride along
      </button>
      <fieldset className="layers">
        <legend>Layers</legend>
        {(Object.keys(LAYER_NAMES) as (keyof Layers)[]).map((name) => (
          <label key={name} className="check">
            <input
              type="checkbox"
              checked={props.layers[name]}
              onChange={(event) => props.onLayers({ ...props.layers, [name]: event.target.checked })}
            />
            {LAYER_NAMES[name]}
          </label>
        ))}
      </fieldset>
      <div className="row">
        <span className="dim">Path by</span>
        <Segmented label="Path coloured by" value={props.colouring} choices={COLOURINGS} onChange={props.onColouring} />
      </div>
      <Legend colouring={props.colouring} />
      <Bookmarks key={capture.id} captureId={capture.id} currentView={props.currentView} onView={props.onView} />
      <button type="button" onClick={props.onScreenshot}>
        <Icon name="camera" /> Screenshot
      </button>
    </aside>
  );
}

function Legend({ colouring }: { colouring: Colouring }): JSX.Element {
  if (colouring === "speed")
    return (
      <div className="legend speed">
        <span>slow</span>
        <svg viewBox="0 0 60 6" preserveAspectRatio="none" aria-hidden="true">
          {SPEED_COLOURS.map((fill, i) => (
            <rect key={fill} x={10 * i} width={10.2} height={6} fill={fill} />
          ))}
        </svg>
        <span>fast</span>
      </div>
    );
  return (
    <ul className="legend">
      {STATES.map((state) => (
        <li key={state} title={trackingHint[state]}>
          <svg viewBox="0 0 14 6" aria-hidden="true">
            <rect width="14" height="4" y="1" rx="2" fill={STATE_COLOURS[state]} />
          </svg>
          {state}
        </li>
      ))}
    </ul>
  );
}

function Bookmarks({
  captureId,
  currentView,
  onView,
}: {
  captureId: string;
  currentView: () => { camera: number[]; frame: number | null };
  onView: (camera: number[], frame: number | null) => void;
}): JSX.Element {
  const [bookmarks, setBookmarks] = useState(() => readBookmarks(captureId));
  const keep = (next: Bookmark[]): void => {
    setBookmarks(next);
    try {
      writeBookmarks(captureId, next);
    } catch {
      toast("This browser does not let the page keep bookmarks.", { tone: "problem" });
    }
  };
  return (
    <section className="bookmarks" aria-label="Bookmarks">
      <div className="row">
        <span className="dim">Bookmarks</span>
        <button
          type="button"
          onClick={() => {
            const names = new Set(bookmarks.map((one) => one.name));
            let number = bookmarks.length + 1;
            while (names.has(`View ${number}`)) number += 1;
            keep([...bookmarks, { name: `View ${number}`, ...currentView() }]);
          }}
        >
          <Icon name="bookmark" /> Add
        </button>
      </div>
      {bookmarks.length > 0 && (
        <ul>
          {bookmarks.map((one, i) => (
            <li key={one.name}>
              <button type="button" className="bare" onClick={() => onView(one.camera, one.frame)}>
                {one.name}
                {one.frame !== null && <span className="dim"> frame {count(one.frame)}</span>}
              </button>
              <button
                type="button"
                className="bare"
                aria-label={`Remove ${one.name}`}
                onClick={() => keep(bookmarks.filter((_, k) => k !== i))}
              >
                <Icon name="close" />
              </button>
            </li>
          ))}
        </ul>
      )}
    </section>
  );
}
