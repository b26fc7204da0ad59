/** How the live reconstruction stands. */

import type { JSX } from "react";

import type { Reconstruction } from "../api/types";
import { count, decibel, duration, percent, small } from "../state/format";
import { go } from "../state/route";
import { JobBadge, Meter, Panel, Stat, trackingHint } from "../ui/parts";
import { Icon } from "../ui/icons";

export function Progress({ job }: { job: Reconstruction | null }): JSX.Element {
  if (job === null)
    return (
      <Panel title="Reconstruction">
        <p className="dim">None for this capture. Start one with Reconstruct ticked, or run it later from Captures.</p>
      </Panel>
    );
  const running = job.state === "running" || job.state === "queued";
  const follows = job.stage === "waiting" || job.stage === "tracking";
  return (
    <Panel title="Reconstruction" aside={<JobBadge job={job} />}>
      <dl className="stats">
        <Stat name="Stage">{job.stage}</Stat>
        <Stat name="Poses">{count(job.poses)}</Stat>
        <Stat name="Splats">{count(job.splats)}</Stat>
        <Stat name="PSNR" hint="Estimate from the views it was made of">
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
      {running && follows && job.tracking_state !== "track" && <p>{trackingHint[job.tracking_state]}</p>}
      {(follows || !running) && job.reason !== "" && (
        <p className={job.state === "failed" ? "problem" : "dim"}>{job.reason}</p>
      )}
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
