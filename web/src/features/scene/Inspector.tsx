/** Settings of the scene view: version, camera control, layers, legend, bookmarks. */

import { type JSX, useEffect, useRef, useState } from "react";

import { address, revert } from "../../shared/api/calls";
import type { Capture, Closure, Reconstruction, Sensor, Version } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { nameOf, progressText } from "../../shared/state/capture";
import { count, decibel, duration, percent } from "../../shared/state/format";
import { isEnded } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { ActionButton } from "../../shared/ui/access";
import { DownloadLink } from "../../shared/ui/DownloadLink";
import { Icon } from "../../shared/ui/icons";
import { JobBadge, JobReason, Meter, Segmented, Stat, trackingMeaning, Warnings } from "../../shared/ui/parts";
import { BookmarksPanel } from "./BookmarksPanel";
import type { Colouring, Path } from "./path";
import { MAX_WIDTH_PX, type LineStyle, SPEED_STYLES, STATE_STYLES, STATES } from "./stateStyles";
import type { Closures } from "./useClosures";
import type { Comparison } from "./useComparison";
import type { Shown } from "./useScene";
import type { Layers, Size, Steering, Viewer } from "./Viewer";
import { ViewPanel, type Shows } from "./ViewPanel";
import { CleanPanel } from "./CleanPanel";
import { ComparePanel } from "./ComparePanel";
import { MeasurePanel } from "./MeasurePanel";
import { ScreenshotTool } from "./ScreenshotTool";
import type { Preset } from "./presets";
import { headsetFound } from "./vr";

const LAYER_NAMES: Record<keyof Layers, string> = {
  splats: "Splats",
  path: "Path",
  loops: "Closed loops",
  frustum: "Frustum",
  grid: "Grid",
  axes: "Axes",
};
const STEERINGS = [
  {
    value: "orbit",
    label: "Orbit",
    hint: "Drag: rotate; right drag or arrow keys: pan; wheel: zoom. By touch: one finger rotates, two pan and zoom, a double tap turns to a point",
  },
  { value: "fly", label: "Fly", hint: "Click the scene; W A S D R F: move, Q E: roll, drag: look around" },
] as const;
const COLOURINGS = [
  { value: "state", label: "State" },
  { value: "speed", label: "Speed" },
] as const;

export interface InspectorProps {
  viewer: Viewer | null;
  capture: Capture;
  job: Reconstruction;
  /** The versions that are kept, oldest first. */
  versions: readonly Version[];
  /** The version shown; null: the newest. */
  pinned: Version | null;
  onVersion: (version: number | null) => void;
  shown: Shown | null;
  loading: boolean;
  closures: Closures;
  onTime: (time_s: number) => void;
  full: boolean;
  onFull: () => void;
  layers: Layers;
  onLayers: (layers: Layers) => void;
  colouring: Colouring;
  onColouring: (colouring: Colouring) => void;
  steering: Steering;
  onSteering: (steering: Steering) => void;
  ride: boolean;
  shows: Shows;
  onShows: (shows: Shows) => void;
  fov: number;
  onFov: (fov: number) => void;
  onPreset: (preset: Preset) => void;
  onRide: (ride: boolean) => void;
  comparison: Comparison | null;
  onHome: () => void;
  /** With the optics of the version that is shown. */
  sensor: Sensor | null;
  path: Path | null;
  onScreenshot: (size: Size | null) => void;
  onCopyLink: () => void;
  currentView: () => { camera: number[]; frame: number | null };
  onView: (camera: number[], frame: number | null) => void;
}

export function Inspector(props: InspectorProps): JSX.Element {
  const { capture, job, pinned, shown } = props;
  const running = job.state === "running" || job.state === "queued";
  return (
    <aside className="inspector" aria-label="Scene settings">
      <header>
        <strong>{nameOf(capture)}</strong>
        <JobBadge job={job} />
        <button
          type="button"
          className="bare"
          aria-label="Copy link"
          title={
            isEnded(job)
              ? "Copy a link to what is seen: this version, moment and view"
              : "Copy a link to this moment and view; the scene still grows, and the link shows its newest version then"
          }
          onClick={props.onCopyLink}
        >
          <Icon name="link" />
        </button>
      </header>
      <JobReason job={job} />
      <Warnings texts={job.warnings} />
      <Versions {...props} />
      <dl className="stats">
        <Stat name="Splats shown" hint={`${count((pinned ?? job).splats)} in the scene`}>
          {shown === null ? "–" : count(shown.splats)}
        </Stat>
        <Stat name="Poses">{count((pinned ?? job).poses)}</Stat>
        <Stat name="PSNR">{decibel((pinned ?? job).psnr_db)}</Stat>
      </dl>
      {running && job.stage === "refining" && (
        <div className="refining">
          <Meter share={job.progress} label="Refinement" />
          <span>
            {percent(job.progress)} refined{job.eta_s !== null && `, about ${duration(job.eta_s)} left`}
          </span>
        </div>
      )}
      {job.state === "queued" && <p className="dim hint">{progressText(job)}</p>}
      {shown !== null && !shown.whole && (
        <button type="button" disabled={props.full} onClick={props.onFull}>
          <Icon name="layers" />{" "}
          {props.full ? "Loading all splats…" : `Show all ${count((pinned ?? job).splats)} splats`}
        </button>
      )}
      <div className="row">
        <Segmented label="Camera control" value={props.steering} choices={STEERINGS} onChange={props.onSteering} />
        <button type="button" onClick={props.onHome} title="Back to the initial view">
          <Icon name="home" /> Home
        </button>
      </div>
      <p className="dim hint">{STEERINGS.find((one) => one.value === props.steering)?.hint}</p>
      <ViewPanel {...props} />
      <Headset viewer={props.viewer} />
      <button type="button" aria-pressed={props.ride} onClick={() => props.onRide(!props.ride)}>
        <Icon name="eye" /> Ride along
      </button>
      <ComparePanel {...props} />
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
      <Loops closures={props.closures} onTime={props.onTime} />
      <MeasurePanel viewer={props.viewer} jobId={job.id} version={shown?.version ?? 0} />
      <CleanPanel
        viewer={props.viewer}
        job={job}
        versions={props.versions}
        newest={pinned === null}
        free={!props.ride && props.comparison === null}
        whole={shown?.whole ?? false}
      />
      {shown !== null && <Downloads job={job} version={shown.version} />}
      <BookmarksPanel
        key={capture.id}
        capture={capture}
        job={job}
        version={pinned?.version ?? null}
        sensor={props.sensor}
        path={props.path}
        currentView={props.currentView}
        onView={props.onView}
      />
      <ScreenshotTool onScreenshot={props.onScreenshot} />
    </aside>
  );
}

/** The splats of the version that is on the canvas, all of them. */
function Downloads({ job, version }: { job: Reconstruction; version: number }): JSX.Element {
  return (
    <div className="row" role="group" aria-label={`Download version ${version}`}>
      <span className="dim">Version {version} as</span>
      {(["ply", "spz"] as const).map((format) => (
        <DownloadLink key={format} href={address.scene(job.id, format, version)}>
          {format.toUpperCase()}
        </DownloadLink>
      ))}
    </div>
  );
}

/** For those who have a headset. */
function Headset({ viewer }: { viewer: Viewer | null }): JSX.Element | null {
  const [found, setFound] = useState(false);
  const [shown, setShown] = useState(false);
  useEffect(() => {
    void headsetFound().then(setFound);
  }, []);
  if (!found || viewer === null) return null;
  return (
    <button
      type="button"
      disabled={shown}
      title="The scene around you, two metres deep, from where this view is taken"
      onClick={() => {
        setShown(true);
        void attempt(() => viewer.enterVr()).finally(() => setShown(false));
      }}
    >
      <Icon name="eye" /> Enter VR
    </button>
  );
}

/** Choice of a published version; the service keeps earlier ones. */
function Versions({ job, versions, pinned, onVersion }: InspectorProps): JSX.Element | null {
  const choice = useRef<HTMLSelectElement>(null);
  if (job.version === 0) return null;
  return (
    <>
      <label className="row version">
        <span className="dim">Version</span>
        <select
          ref={choice}
          value={pinned?.version ?? ""}
          onChange={(event) => onVersion(event.target.value === "" ? null : Number(event.target.value))}
        >
          <option value="">newest, {job.version}</option>
          {versions
            .filter((one) => one.version < job.version || one === pinned)
            .reverse()
            .map((one) => (
              <option key={one.version} value={one.version}>
                {one.version}: {count(one.splats)} splats, {decibel(one.psnr_db)}
              </option>
            ))}
        </select>
      </label>
      {pinned !== null && pinned.version < job.version && (
        <ActionButton
          disabled={!isEnded(job)}
          title={isEnded(job) ? "Publishes it again, as the newest" : "When the reconstruction has ended"}
          onClick={() =>
            void goBack(job, pinned.version, () => {
              choice.current?.focus(); // this button goes
              onVersion(null);
            })
          }
        >
          <Icon name="back" /> Go back to version {pinned.version}
        </ActionButton>
      )}
    </>
  );
}

/** Publish an earlier version again; the one before is kept as a version, so that this can be undone, too. */
const goBack = (job: Reconstruction, version: number, after: () => void): Promise<boolean> =>
  attempt(async () => {
    await revert(job.id, { version: job.version, to: version });
    after();
    toast(`The scene is as version ${version} was`);
  });

/** Legend of the path; the timeline always shows the states. */
function Legend({ colouring }: { colouring: Colouring }): JSX.Element {
  return (
    <>
      {colouring === "speed" && (
        <div className="legend speed" title="Each style covers one fifth of the highest speed">
          <span>slow</span>
          {SPEED_STYLES.map((style) => (
            <Swatch key={style.name} style={style} />
          ))}
          <span>fast</span>
        </div>
      )}
      <ul className="legend" aria-label="States of the tracking">
        {STATES.map((state) => (
          <li key={state} title={trackingMeaning[state]}>
            <Swatch style={STATE_STYLES[state]} />
            {state}
          </li>
        ))}
        <li title="Missing frames, in the timeline">
          <svg className="swatch missing" viewBox={`0 0 ${SWATCH_PX} ${MAX_WIDTH_PX + 4}`} aria-hidden="true">
            <rect className="glass" y={2} width={SWATCH_PX} height={MAX_WIDTH_PX} />
            <rect className="overhang" x={SWATCH_PX / 2 - 3} width={5} height={MAX_WIDTH_PX + 4} />
            <rect className="cut" x={SWATCH_PX / 2 - 3} y={2} width={5} height={MAX_WIDTH_PX} />
          </svg>
          missing
        </li>
        <li title="The camera sees a place again: the empty diamond is the earlier sight of it">
          <svg className="swatch" viewBox={`0 0 ${SWATCH_PX} ${MAX_WIDTH_PX + 4}`} aria-hidden="true">
            <path className="loop earlier" d="M4 5.5 8 1.5 12 5.5 8 9.5z" />
            <path className="loop" d="M20 5.5 24 1.5 28 5.5 24 9.5z" />
          </svg>
          closed loop
        </li>
      </ul>
    </>
  );
}

const SWATCH_PX = 32;

function Swatch({ style }: { style: LineStyle }): JSX.Element {
  const middle = MAX_WIDTH_PX / 2 + 2;
  return (
    <svg className="swatch" viewBox={`0 0 ${SWATCH_PX} ${2 * middle}`} aria-hidden="true">
      <rect className="glass" y={1} width={SWATCH_PX} height={2 * middle - 2} rx={2} />
      <line
        x1={0}
        x2={SWATCH_PX}
        y1={middle}
        y2={middle}
        stroke={`var(--${style.colour})`}
        strokeWidth={style.width_px}
        strokeDasharray={style.dash_px?.join(" ")}
      />
    </svg>
  );
}

/** The newest closed loops in words; a loop that is closed while the page looks is said at once. */
function Loops({ closures, onTime }: { closures: Closures; onTime: (time_s: number) => void }): JSX.Element {
  const newest = closures.all.slice(-LOOPS_LISTED).reverse();
  const last = closures.all.at(-1);
  return (
    <section className="bookmarks loops" aria-label="Closed loops">
      <p className="hidden" role="status">
        {closures.fresh > 0 && last !== undefined && `Loop closed: ${inWords(last)}`}
      </p>
      {newest.length > 0 && (
        <>
          <span className="dim">Closed loops: {count(closures.all.length)}</span>
          <ul>
            {newest.map((one, i) => (
              <li key={`${one.earlier_s} ${one.later_s}`}>
                <button
                  type="button"
                  className={i < closures.fresh ? "bare fresh" : "bare"}
                  title={inWords(one)}
                  onClick={() => onTime(one.later_s)}
                >
                  <Icon name="loop" /> {duration(one.later_s)} <span className="dim">sees again</span>{" "}
                  {duration(one.earlier_s)}
                </button>
              </li>
            ))}
          </ul>
        </>
      )}
    </section>
  );
}

/** Closed loops that are listed: the newest. */
const LOOPS_LISTED = 5;
const inWords = (loop: Closure): string =>
  `at ${duration(loop.later_s)} the camera sees again what it saw at ${duration(loop.earlier_s)}`;
