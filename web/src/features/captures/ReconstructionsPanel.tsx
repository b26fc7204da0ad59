/** The reconstructions of a capture: which one is shown, which one it is compared with, and new ones. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction, Task } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { progressText } from "../../shared/state/capture";
import { count, decibel, when } from "../../shared/state/format";
import { adjust, go } from "../../shared/state/route";
import { ENDED } from "../../shared/state/keptJobs";
import { isEnded, removeReconstruction, storeReconstruction } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { Icon } from "../../shared/ui/icons";
import { Badge, Empty, JobBadge, JobReason, jobTone, Panel, Warnings } from "../../shared/ui/parts";
import { Table } from "../../shared/ui/Table";

/** Reconstructions that are listed at first, and more of at a time. */
const ROWS = 100;
const COLUMNS = [
  { name: "Show" },
  { name: "Compare" },
  { name: "Started" },
  { name: "State" },
  { name: "Poses", number: true },
  { name: "Splats", number: true },
  { name: "PSNR", number: true },
  { name: "Actions", hidden: true },
];

const TASKS: Record<Exclude<Task, "reconstruct">, string> = {
  extend: "extends a map",
  merge: "two maps merged",
  localise: "found in a map",
};

export function ReconstructionsPanel({
  jobs,
  job,
  other,
  nameOf,
  onOther,
  onRerun,
  rerunning,
  onMap,
  mapping,
  canRun,
  total,
  onMore,
}: {
  /** Newest first. */
  jobs: readonly Reconstruction[];
  /** The one shown. */
  job: Reconstruction | null;
  /** The one it is compared with. */
  other: Reconstruction | null;
  nameOf: (job: Reconstruction) => string;
  onOther: (id: string | null) => void;
  onRerun: () => void;
  rerunning: boolean;
  onMap: () => void;
  mapping: boolean;
  canRun: boolean;
  /** Number of all, of which `jobs` may be the newest. */
  total: number;
  /** Fetches those before the one with this id. */
  onMore: (before: string) => void;
}): JSX.Element {
  const [rows, setRows] = useState(ROWS);
  const listed = jobs.filter((one, at) => at < rows || one.id === job?.id || one.id === other?.id);
  const more = (): void => {
    const last = jobs.at(-1);
    if (jobs.length < Math.min(rows + ROWS, total) && last !== undefined) onMore(last.id);
    setRows(rows + ROWS);
  };
  return (
    <Panel
      title="Reconstructions"
      aside={
        <span className="buttons">
          <ActionButton aria-expanded={mapping} disabled={!canRun && job === null} onClick={onMap}>
            <Icon name="scene" /> Use a map
          </ActionButton>
          <ActionButton
            aria-expanded={rerunning}
            disabled={!canRun}
            title={canRun ? undefined : "Needs a complete recording"}
            onClick={onRerun}
          >
            <Icon name="again" /> {jobs.length === 0 ? "Reconstruct" : "Re-run with other options"}
          </ActionButton>
        </span>
      }
    >
      {jobs.length === 0 ? (
        <Empty icon="scene" title="None yet" />
      ) : (
        <Table
          label="Table of reconstructions"
          className="grid jobs"
          columns={COLUMNS}
          below={
            total > listed.length && (
              <p className="below">
                <span className="dim" role="status">
                  {count(listed.length)} of {count(total)}
                </span>
                {rows < ENDED && (
                  <button type="button" className="more" onClick={more}>
                    Show more
                  </button>
                )}
              </p>
            )
          }
        >
          {listed.map((one) => (
            <Row
              key={one.id}
              job={one}
              name={nameOf(one)}
              shown={one.id === job?.id}
              compared={one.id === other?.id}
              onCompare={(wanted) => onOther(wanted ? one.id : null)}
            />
          ))}
        </Table>
      )}
    </Panel>
  );
}

function Row({
  job,
  name,
  shown,
  compared,
  onCompare,
}: {
  job: Reconstruction;
  name: string;
  shown: boolean;
  compared: boolean;
  onCompare: (wanted: boolean) => void;
}): JSX.Element {
  return (
    <tr>
      <td>
        <input
          type="radio"
          name="shown"
          aria-label={`Show reconstruction ${name}`}
          checked={shown}
          onChange={() => adjust({ reconstruction: job.id })}
        />
      </td>
      <td>
        <input
          type="checkbox"
          aria-label={`Compare with reconstruction ${name}`}
          disabled={shown}
          checked={compared}
          onChange={(event) => onCompare(event.target.checked)}
        />
      </td>
      <td>
        {name} {job.name !== "" && <b>{job.name}</b>} {when(job.created_at)}{" "}
        {job.live && <span className="dim">live</span>}
        {job.task !== "reconstruct" && <span className="dim">{TASKS[job.task]}</span>}
        {job.node !== "" && <span className="dim">on {job.node}</span>}
        {job.notes !== "" && (
          <span className="dim notes" title={job.notes}>
            {job.notes}
          </span>
        )}
      </td>
      <td>
        {job.state === "running" ? (
          <Badge tone={jobTone.running}>{`${job.stage} ${Math.round(100 * job.progress)} %`}</Badge>
        ) : (
          <JobBadge job={job} />
        )}
        {job.state === "queued" && <span className="dim reason">{progressText(job)}</span>}
        <JobReason job={job} />
        <Warnings texts={job.warnings} />
      </td>
      <td className="number">{count(job.poses)}</td>
      <td className="number">{count(job.splats)}</td>
      <td className="number">{decibel(job.psnr_db)}</td>
      <td className="number">
        {isEnded(job) ? (
          <>
            <SceneButton job={job} name={name} />
            <DeleteButton job={job} name={name} />
          </>
        ) : (
          <CancelButton job={job} />
        )}
      </td>
    </tr>
  );
}

function SceneButton({ job, name }: { job: Reconstruction; name: string }): JSX.Element {
  return (
    <button
      type="button"
      className="bare"
      disabled={job.version === 0}
      aria-label={`Scene of reconstruction ${name}`}
      onClick={() =>
        go({
          page: "scene",
          capture: job.capture_id,
          reconstruction: job.id,
          frame: null,
          camera: null,
          ride: false,
        })
      }
    >
      <Icon name="scene" />
    </button>
  );
}

/** Asks once more, since a reconstruction that is deleted cannot be brought back. */
function DeleteButton({ job, name }: { job: Reconstruction; name: string }): JSX.Element {
  const [asked, setAsked] = useState(false);
  const remove = async (): Promise<void> => {
    await calls.removeReconstruction(job.id);
    adjust({ reconstruction: null });
    removeReconstruction(job.id);
  };
  return asked ? (
    <ActionButton onClick={() => void attempt(remove)}>Delete for good</ActionButton>
  ) : (
    <ActionButton className="bare" aria-label={`Delete reconstruction ${name}`} onClick={() => setAsked(true)}>
      <Icon name="trash" />
    </ActionButton>
  );
}

function CancelButton({ job }: { job: Reconstruction }): JSX.Element {
  const cancel = async (): Promise<void> => storeReconstruction(await calls.cancel(job.id));
  return <ActionButton onClick={() => void attempt(cancel)}>Cancel</ActionButton>;
}
