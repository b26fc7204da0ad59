/** What the scene is compared with and how, and what differs. */

import { type JSX, type Ref, useEffect, useRef, useState } from "react";

import type { Capture, Reconstruction, Version } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { calledOf, nameOf, numberOf } from "../../shared/state/capture";
import { count, decibel, small } from "../../shared/state/format";
import { adjust } from "../../shared/state/route";
import { loadComplete, useService } from "../../shared/state/store";
import { Segmented } from "../../shared/ui/parts";
import { pathOfTum } from "./similarity";
import { COMPARED_STYLES } from "./stateStyles";
import { type Comparison, type How, stopComparing } from "./useComparison";
import { useVersions } from "./useVersions";

const HOWS: readonly { value: How; label: string; hint: string }[] = [
  { value: "side", label: "Beside", hint: "Two views with one camera; only splats and paths are drawn" },
  { value: "wipe", label: "Wipe", hint: "Drag the line, or move it with the arrow keys" },
  { value: "difference", label: "Difference", hint: "Four times the difference of the pictures" },
  { value: "paths", label: "Paths", hint: "Both paths in one view" },
];

export interface CompareProps {
  capture: Capture;
  job: Reconstruction;
  /** Versions of the reconstruction that is shown. */
  versions: readonly Version[];
  pinned: Version | null;
  comparison: Comparison | null;
}

export function ComparePanel(props: CompareProps): JSX.Element {
  const [open, setOpen] = useState(props.comparison !== null);
  return (
    <details className="tool" open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Compare</summary>
      {open && <Comparing {...props} />}
    </details>
  );
}

function Comparing({ capture, job, versions, pinned, comparison }: CompareProps): JSX.Element {
  const shownVersion = pinned?.version ?? job.version;
  const choice = useRef<HTMLSelectElement>(null);
  return (
    <>
      <Choice
        field={choice}
        capture={capture}
        job={job}
        versions={versions}
        shownVersion={shownVersion}
        comparison={comparison}
      />
      {comparison === null ? (
        <p className="dim hint">Choose a version or a reconstruction to see it beside this one.</p>
      ) : (
        <>
          <Segmented
            label="How to compare"
            value={comparison.how}
            choices={HOWS}
            onChange={(how) => adjust({ how: how === "side" ? "" : how })}
          />
          <p className="dim hint">{HOWS.find((one) => one.value === comparison.how)?.hint}</p>
          <Figures job={job} pinned={pinned} comparison={comparison} />
          <Truth comparison={comparison} frameRateHz={capture.sensor?.frame_rate_hz ?? null} />
          <button
            type="button"
            onClick={() => {
              choice.current?.focus(); // this button goes
              stopComparing();
            }}
          >
            Stop comparing
          </button>
        </>
      )}
    </>
  );
}

/** What there is to compare with: versions, other reconstructions of the capture, and those of other captures. */
function Choice({
  field,
  capture,
  job,
  versions,
  shownVersion,
  comparison,
}: Omit<CompareProps, "pinned"> & { field: Ref<HTMLSelectElement>; shownVersion: number }): JSX.Element {
  const all = useService((state) => state.reconstructions);
  const captures = useService((state) => state.captures);
  useEffect(() => {
    void attempt(loadComplete);
  }, []);
  const others = Object.values(all)
    .filter((one) => one.id !== job.id && one.version > 0)
    .sort((a, b) => (a.id < b.id ? 1 : -1));
  const same = others.filter((one) => one.capture_id === capture.id);
  const far = others.filter((one) => one.capture_id !== capture.id);
  const other = comparison?.job ?? null;
  const ofOther = useVersions(other?.id === job.id ? null : other);
  // The newest of this capture are known, of others those that are complete.
  const nameOfNear = (one: Reconstruction): string =>
    `${numberOf(one, Object.values(all), capture.reconstruction_count)}, ${calledOf(one)}`;
  const nameOfFar = (one: Reconstruction): string => {
    const from = captures[one.capture_id];
    return `${from === undefined ? "an older capture" : nameOf(from)}, ${calledOf(one)}`;
  };
  const nameOfAny = (one: Reconstruction): string => (one.capture_id === capture.id ? nameOfNear(one) : nameOfFar(one));
  // Entries of the list may be longer than the panel is wide.
  const chosen =
    other === null || other.id === job.id
      ? null
      : comparison?.version == null
        ? entryOf(nameOfAny(other), other)
        : `${nameOfAny(other)}, its version ${comparison.version}`;
  const value = comparison === null ? "" : `${comparison.job?.id ?? ""}.${comparison.version ?? ""}`;
  return (
    <>
      <label className="wide">
        <span className="dim">With</span>
        <select
          ref={field}
          value={value}
          onChange={(event) => {
            const [against = "", version = ""] = event.target.value.split(".");
            if (against === "") stopComparing();
            else
              adjust({
                against,
                againstVersion: version === "" ? null : Number(version),
                ...(comparison === null ? { ride: false, how: "" } : {}),
              });
          }}
        >
          <option value="">nothing</option>
          <optgroup label="Versions of this reconstruction">
            {[...versions]
              .reverse()
              .filter((one) => one.version !== shownVersion)
              .map((one) => (
                <option key={one.version} value={`${job.id}.${one.version}`}>
                  version {one.version}: {count(one.splats)} splats, {decibel(one.psnr_db)}
                </option>
              ))}
          </optgroup>
          <Reconstructions label="Of this capture" jobs={same} nameOf={nameOfNear} />
          <Reconstructions label="Of other captures" jobs={far} nameOf={nameOfFar} />
          {other !== null && other.id !== job.id && (
            <optgroup label="Versions of the other reconstruction">
              {[...ofOther].reverse().map((one) => (
                <option key={one.version} value={`${other.id}.${one.version}`}>
                  its version {one.version}
                </option>
              ))}
            </optgroup>
          )}
        </select>
      </label>
      {chosen !== null && <p className="dim hint chosen">With {chosen}</p>}
    </>
  );
}

const entryOf = (name: string, one: Reconstruction): string =>
  `${name}: ${count(one.splats)} splats, ${decibel(one.psnr_db)}`;

function Reconstructions({
  label,
  jobs,
  nameOf: nameOfJob,
}: {
  label: string;
  jobs: readonly Reconstruction[];
  nameOf: (job: Reconstruction) => string;
}): JSX.Element | null {
  if (jobs.length === 0) return null;
  return (
    <optgroup label={label}>
      {jobs.map((one) => (
        <option key={one.id} value={`${one.id}.`}>
          {entryOf(nameOfJob(one), one)}
        </option>
      ))}
    </optgroup>
  );
}

function Figures({
  job,
  pinned,
  comparison,
}: {
  job: Reconstruction;
  pinned: Version | null;
  comparison: Comparison;
}): JSX.Element {
  const other = comparison.job;
  const versions = useVersions(other);
  const second = versions.find((one) => one.version === comparison.version) ?? other;
  const first = pinned ?? job;
  const { errors, truth } = comparison;
  const sameCapture = other?.capture_id === job.capture_id;
  return (
    <>
      <table className="grid compared">
        <thead>
          <tr>
            <td />
            <th scope="col">
              <Key which="first" /> First
            </th>
            <th scope="col">
              <Key which="second" /> Second
            </th>
          </tr>
        </thead>
        <tbody>
          <Line name="Version" first={first.version.toString()} second={second?.version.toString() ?? "–"} />
          <Line name="Splats" first={count(first.splats)} second={second == null ? "–" : count(second.splats)} />
          <Line name="PSNR" first={decibel(first.psnr_db)} second={decibel(second?.psnr_db)} />
          {truth !== null && (
            <Line name="Path error" first={lengthText(errors.first)} second={lengthText(errors.second)} />
          )}
        </tbody>
      </table>
      <p className="dim hint" role="status">
        {errors.between !== null && comparison.aligned
          ? `The second is laid over the first by its poses; the paths differ by ${small(errors.between)} units (RMS).`
          : sameCapture
            ? "The paths have too few poses at the same times to be laid over each other."
            : "Scenes of other captures are shown in their own coordinates."}
      </p>
    </>
  );
}

function Line({ name, first, second }: { name: string; first: string; second: string }): JSX.Element {
  return (
    <tr>
      <th scope="row">{name}</th>
      <td>{first}</td>
      <td>{second}</td>
    </tr>
  );
}

const KEY_PX = { width: 22, height: 10 };

/** How a path is drawn. */
function Key({ which }: { which: keyof typeof COMPARED_STYLES }): JSX.Element {
  const style = COMPARED_STYLES[which];
  const middle = KEY_PX.height / 2;
  return (
    <svg className="path-key" viewBox={`0 0 ${KEY_PX.width} ${KEY_PX.height}`} aria-hidden="true">
      <rect className="glass" width={KEY_PX.width} height={KEY_PX.height} rx={2} />
      <line
        x1={0}
        x2={KEY_PX.width}
        y1={middle}
        y2={middle}
        stroke={`var(--${style.colour})`}
        strokeWidth={style.width_px}
      />
    </svg>
  );
}

/** The true path, from a file that this browser reads. */
function Truth({ comparison, frameRateHz }: { comparison: Comparison; frameRateHz: number | null }): JSX.Element {
  const { truth, onTruth, errors } = comparison;
  return (
    <>
      <label className="truth">
        <span className="dim">
          <Key which="truth" /> True path, a TUM file
        </span>
        <input
          type="file"
          accept=".tum,.txt"
          disabled={frameRateHz === null}
          onChange={(event) => {
            const file = event.target.files?.[0];
            if (file === undefined) onTruth(null);
            else void attempt(async () => onTruth(pathOfTum(await file.text(), frameRateHz ?? 1)));
          }}
        />
      </label>
      {truth !== null && errors.first === null && (
        <p className="dim hint" role="status">
          The file has no poses at the times of the path; its times are seconds since the start of the capture.
        </p>
      )}
    </>
  );
}

const lengthText = (metres: number | null): string =>
  metres === null ? "–" : metres < 1 ? `${(1000 * metres).toPrecision(3)} mm` : `${metres.toPrecision(3)} m`;
