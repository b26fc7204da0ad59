/** Running and queued reconstructions of all captures. */

import type { JSX } from "react";

import type { Reconstruction } from "../../shared/api/types";
import { nameOf, progressText } from "../../shared/state/capture";
import { activeJobs, useService } from "../../shared/state/store";
import { PageLink } from "../../shared/ui/PageLink";
import { JobBadge, Panel } from "../../shared/ui/parts";

export function Queue({ shown }: { shown: string | null }): JSX.Element | null {
  const all = useService((state) => state.reconstructions);
  const jobs = activeJobs(all);
  if (jobs.every((job) => job.capture_id === shown)) return null;
  return (
    <Panel title="Reconstructions under way">
      <ol className="queue">
        {jobs.map((job) => (
          <Turn key={job.id} job={job} />
        ))}
      </ol>
    </Panel>
  );
}

function Turn({ job }: { job: Reconstruction }): JSX.Element {
  const capture = useService((state) => state.captures[job.capture_id] ?? null);
  return (
    <li>
      <PageLink to={{ page: "captures", capture: job.capture_id, reconstruction: job.id }}>
        {capture === null ? "an older capture" : nameOf(capture)}
      </PageLink>
      <JobBadge job={job} />
      <span className="dim">{progressText(job)}</span>
    </li>
  );
}
