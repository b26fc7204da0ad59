/** Progress of the live reconstruction. */

import type { JSX } from "react";

import type { Reconstruction } from "../../shared/api/types";
import { count, decibel, duration, percent, small } from "../../shared/state/format";
import { progressText } from "../../shared/state/capture";
import { go } from "../../shared/state/route";
import { JobBadge, JobReason, Meter, Panel, Stat, trackingHint, Warnings } from "../../shared/ui/parts";
import { Icon } from "../../shared/ui/icons";

export function Progress({ job }: { job: Reconstruction | null }): JSX.Element {
  if (job === null)
    return (
      <Panel title="Reconstruction">
        <p className="dim">
          None for this capture. Start captures with Reconstruct checked, or reconstruct a recording on the Captures
          page.
        </p>
      </Panel>
    );
  const running = job.state === "running" || job.state === "queued";
  const follows = job.stage === "waiting" || job.stage === "tracking";
  return (
    <Panel title="Reconstruction" aside={<JobBadge job={job} />}>
      <dl className="stats">
        <Stat name="Stage">{job.stage}</Stat>
        {job.node !== "" && <Stat name="Machine">{job.node}</Stat>}
        <Stat name="Poses">{count(job.poses)}</Stat>
        <Stat name="Splats">{count(job.splats)}</Stat>
        <Stat name="PSNR" hint="Of the training views">
          {decibel(job.psnr_db)}
        </Stat>
        <Stat name="Loss">{small(job.loss)}</Stat>
        <Stat name="Version">{job.version === 0 ? "–" : job.version}</Stat>
      </dl>
      {running && job.stage === "refining" && (
        <div className="refining">
          <Meter share={job.progress} label="Refinement" />
          <span>
            {percent(job.progress)}
            {job.eta_s !== null && `, ${duration(job.eta_s)} left`}
          </span>
        </div>
      )}
      {job.state === "queued" && <p>{progressText(job)}</p>}
      {job.state === "running" && follows && job.tracking_state !== "track" && <p>{trackingHint(job)}</p>}
      {(follows || !running) && <JobReason job={job} />}
      <Warnings texts={job.warnings} />
      <button
        type="button"
        disabled={job.version === 0}
        onClick={() => go({ page: "scene", capture: job.capture_id, reconstruction: null, frame: null, camera: null })}
      >
        <Icon name="scene" /> Open the scene
      </button>
    </Panel>
  );
}
