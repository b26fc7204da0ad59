/** Running and queued reconstructions of all captures. */

import type { JSX } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { nameOf, progressText } from "../../shared/state/capture";
import { activeJobs, storeReconstruction, useService } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { NotifySwitch } from "./NotifySwitch";
import { Icon } from "../../shared/ui/icons";
import { PageLink } from "../../shared/ui/PageLink";
import { JobBadge, Panel } from "../../shared/ui/parts";

export function Queue({ shown }: { shown: string | null }): JSX.Element | null {
  const all = useService((state) => state.reconstructions);
  const jobs = activeJobs(all);
  if (jobs.every((job) => job.capture_id === shown)) return null;
  return (
    <Panel title="Reconstructions under way" aside={<NotifySwitch />}>
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
      <ActionButton
        className="bare"
        aria-label={`Cancel the reconstruction of ${capture === null ? "an older capture" : nameOf(capture)}`}
        title="Cancel"
        onClick={() => void attempt(async () => storeReconstruction(await calls.cancel(job.id)))}
      >
        <Icon name="close" />
      </ActionButton>
    </li>
  );
}
