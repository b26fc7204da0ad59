/** Distances and angles in the scene, its scale in metres, and which way is up. */

import { type JSX, useEffect, useState } from "react";
import type { Vector3 } from "three";

import * as calls from "../../shared/api/calls";
import type { Scale } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton } from "../../shared/ui/access";
import { Segmented } from "../../shared/ui/parts";
import { angle, distance, lengthText, pointsOf, spreadText, type Tool, TOOLS, upOf } from "./measure";
import { usePicking } from "./usePicking";
import type { Viewer } from "./Viewer";

const CHOICES = TOOLS.map(({ value, label }) => ({ value, label }));

interface MeasureProps {
  viewer: Viewer;
  jobId: string;
  /** The version that is measured in; 0 before one is shown. */
  version: number;
}

export function MeasurePanel({ viewer, ...of }: Omit<MeasureProps, "viewer"> & { viewer: Viewer | null }): JSX.Element {
  const [open, setOpen] = useState(false);
  return (
    <details className="tool" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Measure</summary>
      {open && viewer !== null && <Measuring viewer={viewer} {...of} />}
    </details>
  );
}

function Measuring({ viewer, jobId, version }: MeasureProps): JSX.Element {
  const [tool, setTool] = useState<Tool>("distance");
  const [points, setPoints] = useState<readonly Vector3[]>([]);
  const { value: known, again } = useFetch(jobId, () => calls.scale(jobId));
  const earlier = known !== null && version > 0 && version <= known.since;
  const scale = earlier ? null : known;
  const full = points.length >= pointsOf(tool);
  usePicking(viewer, (point) => setPoints(full ? [point] : [...points, point]));
  useEffect(() => {
    viewer.mark(points, tool === "up");
    return () => viewer.mark([], false);
  }, [viewer, points, tool]);

  const store = async (change: Parameters<typeof calls.setScale>[1]): Promise<void> => {
    await attempt(() => calls.setScale(jobId, change));
    again();
  };
  const revision = known?.revision ?? 0;
  const up = tool === "up" ? upOf(points, viewer.eye) : null;
  return (
    <>
      <Segmented
        label="Measure what"
        value={tool}
        choices={CHOICES}
        onChange={(next) => {
          setTool(next);
          setPoints([]);
        }}
      />
      <p className="dim hint">
        {TOOLS.find((one) => one.value === tool)?.ask} With the keyboard: move the view, and press Enter for the point
        in its middle.
      </p>
      <output className="measured" aria-live="polite">
        {resultText(tool, points, scale)}
      </output>
      {!earlier && tool === "distance" && full && (
        <KnownLength
          units={distance(points) ?? 0}
          error={viewer.pixel(points)}
          onLength={(metres_per_unit, sigma) => store({ revision, version, metres_per_unit, sigma })}
        />
      )}
      {!earlier && up !== null && (
        <ActionButton onClick={() => void store({ revision, version, up })}>This is the floor</ActionButton>
      )}
      <TagForm
        onTag={async (side_m) => {
          await attempt(async () => {
            const found = await calls.scaleByTag(jobId, { revision, side_m, family: "36h11" });
            toast(`Found ${found.tags.map((one) => `tag ${one.tag} in ${one.views} views`).join(", ")}`);
          });
          again();
        }}
      />
      {earlier ? (
        <p className="dim hint">
          Version {version} is of an earlier run, in another unit of length: its scale cannot be set. Choose a version
          after {known.since}.
        </p>
      ) : (
        <ScaleText scale={scale} />
      )}
    </>
  );
}

function resultText(tool: Tool, points: readonly Vector3[], scale: Scale | null): string {
  const length = distance(points);
  const turn = angle(points);
  if (tool === "distance" && length !== null) return lengthText(length, scale);
  if (tool === "angle" && turn !== null) return `${turn.toFixed(1)}°`;
  return points.length === 0 ? "–" : `${points.length} of ${pointsOf(tool)} points`;
}

function KnownLength({
  units,
  error,
  onLength,
}: {
  units: number;
  /** Of a point that is clicked, in units: one pixel. */
  error: number;
  onLength: (metresPerUnit: number, sigma: number) => Promise<void>;
}): JSX.Element {
  return (
    <MetresForm
      before="It is"
      label="Known length in metres"
      action="Set the scale"
      ready={(length) => length > 0 && units !== 0}
      onMetres={(length) => onLength(length / units, Math.min((Math.SQRT2 * error) / units, 1))}
    />
  );
}

function TagForm({ onTag }: { onTag: (side_m: number) => Promise<void> }): JSX.Element {
  const [busy, setBusy] = useState(false);
  return (
    <MetresForm
      before="AprilTag of"
      label="Side of the tag's black square in metres"
      start="0.10"
      least="0.001"
      action={busy ? "Searching…" : "Find it"}
      ready={() => !busy}
      onMetres={async (side) => {
        setBusy(true);
        await onTag(side).finally(() => setBusy(false));
      }}
    />
  );
}

function MetresForm({
  before,
  label,
  start = "",
  least = "0",
  action,
  ready,
  onMetres,
}: {
  before: string;
  label: string;
  start?: string;
  least?: string;
  action: string;
  ready: (metres: number) => boolean;
  onMetres: (metres: number) => Promise<void>;
}): JSX.Element {
  const [metres, setMetres] = useState(start);
  return (
    <form
      className="row"
      onSubmit={(event) => {
        event.preventDefault();
        void onMetres(Number(metres));
      }}
    >
      <label className="row">
        <span className="dim">{before}</span>
        <input
          type="number"
          min={least}
          step="any"
          required
          aria-label={label}
          value={metres}
          onChange={(event) => setMetres(event.target.value)}
        />
        <span className="dim">m</span>
      </label>
      <ActionButton type="submit" disabled={!ready(Number(metres))}>
        {action}
      </ActionButton>
    </form>
  );
}

function ScaleText({ scale }: { scale: Scale | null }): JSX.Element {
  const metres = scale?.metres_per_unit ?? null;
  return (
    <p className="dim hint">
      {metres === null
        ? "The scale is not known: a moving camera alone knows no metres."
        : `A unit is ${metres.toPrecision(5)} m${spreadText(scale)}, by ${
            scale?.source === "tag" ? "a tag" : "a known length"
          }.`}{" "}
      {scale?.up == null ? "Up is not known." : "Up is known."}
    </p>
  );
}
