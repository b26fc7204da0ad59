/** Distances and angles in the scene, its scale in metres, and which way is up. */

import { type JSX, useEffect, useState } from "react";
import { createPortal } from "react-dom";
import type { Vector3 } from "three";

import * as calls from "../../shared/api/calls";
import type { Scale } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton } from "../../shared/ui/access";
import { Segmented } from "../../shared/ui/parts";
import { angle, distance, lengthText, pointsOf, scaleText, type Tool, TOOLS, upOf } from "./measure";
import { BaselineForm, BoardForm, type Find, KnownLength, TagForm } from "./ScaleForms";
import { FloorForm, GravityForm } from "./UpForms";
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
  const notes = viewer.canvas.closest(".viewport")?.querySelector(".stage-notes") ?? null;
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
  const find: Find = async (search) => {
    await attempt(async () => toast(await search(revision)));
    again();
  };
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
      {notes !== null &&
        createPortal(
          // Beside the points, too: on a phone this panel is out of sight then.
          <p className="glass" aria-hidden="true">
            {points.length === 0 ? TOOLS.find((one) => one.value === tool)?.ask : resultText(tool, points, scale)}
          </p>,
          notes,
        )}
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
      {tool === "up" ? (
        <>
          <FloorForm jobId={jobId} onFind={find} />
          <GravityForm jobId={jobId} onFind={find} />
        </>
      ) : (
        <>
          <TagForm jobId={jobId} onFind={find} />
          <OtherScales jobId={jobId} onFind={find} />
        </>
      )}
      {earlier ? (
        <p className="dim hint">
          Version {version} is of an earlier run, in another unit of length: its scale cannot be set. Choose a version
          after {known.since}.
        </p>
      ) : (
        <p className="dim hint">{scaleText(scale)}</p>
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

function OtherScales(of: { jobId: string; onFind: Find }): JSX.Element {
  const [open, setOpen] = useState(false);
  return (
    <details className="ways" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>By a board or two cameras</summary>
      {open && (
        <>
          <BoardForm {...of} />
          <BaselineForm {...of} />
        </>
      )}
    </details>
  );
}
