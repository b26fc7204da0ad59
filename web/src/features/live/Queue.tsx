/** Running and queued reconstructions of all captures; that of the capture shown, while it is recorded, is elsewhere on the page. */

import { type JSX, memo } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction, ReconstructionChange } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { nameOf, progressText } from "../../shared/state/capture";
import { count } from "../../shared/state/format";
import { FRONT } from "../../shared/state/keptJobs";
import { activeJobs, storeReconstruction, useService } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { NotifySwitch } from "./NotifySwitch";
import { Icon } from "../../shared/ui/icons";
import { PageLink } from "../../shared/ui/PageLink";
import { JobBadge, Panel } from "../../shared/ui/parts";

export function Queue({ shown }: { shown: string | null }): JSX.Element | null {
  const all = useService((state) => state.reconstructions);
  const queued = useService((state) => state.queued);
  const jobs = activeJobs(all).filter((job) => (job.queue_place ?? 0) <= FRONT);
  const more = queued > FRONT ? queued - jobs.filter((job) => job.state === "queued").length : 0;
  if (jobs.every((job) => job.live && job.capture_id === shown)) return null;
  return (
    <Panel title="Reconstructions under way" aside={<NotifySwitch />}>
      <ol className="queue">
        {jobs.map((job) => (
          <Turn key={job.id} job={job} />
        ))}
      </ol>
      {more > 0 && <p className="dim">and {count(more)} more</p>}
    </Panel>
  );
}

/** Drawn anew only if its job has changed: a change of one place tells of many. */
const Turn = memo(function Turn({ job }: { job: Reconstruction }): JSX.Element {
  const capture = useService((state) => state.captures[job.capture_id] ?? null);
  const name = job.name !== "" ? job.name : capture === null ? "an older capture" : nameOf(capture);
  const change = async (body: ReconstructionChange): Promise<boolean> =>
    attempt(async () => storeReconstruction(await calls.changeReconstruction(job.id, body)));
  const place = job.queue_place;
  return (
    <li>
      <PageLink to={{ page: "captures", capture: job.capture_id, reconstruction: job.id }}>{name}</PageLink>
      <JobBadge job={job} />
      <span className="dim">{progressText(job)}</span>
      <span className="buttons">
        {(place !== null || !job.live) && (
          <ActionButton
            className="bare"
            aria-label={`${job.held ? "Let go of" : place === null ? "Pause" : "Hold"} the reconstruction of ${name}`}
            aria-pressed={job.held}
            title={
              job.held
                ? "Let go: it begins in its turn"
                : place === null
                  ? "Pause: it returns to the queue, and goes on from here later"
                  : "Hold: it stays in the queue"
            }
            onClick={() => void change({ held: !job.held })}
          >
            <Icon name={job.held ? "start" : "pause"} />
          </ActionButton>
        )}
        {place !== null && (
          <>
            <ActionButton
              className="bare"
              aria-label={`Earlier: the reconstruction of ${name}`}
              title="Earlier"
              disabled={place === 1}
              onClick={() => void change({ queue_place: place - 1 })}
            >
              <Icon name="up" />
            </ActionButton>
            <ActionButton
              className="bare"
              aria-label={`Later: the reconstruction of ${name}`}
              title="Later"
              onClick={() => void change({ queue_place: place + 1 })}
            >
              <Icon name="down" />
            </ActionButton>
          </>
        )}
        <ActionButton
          className="bare"
          aria-label={`Cancel the reconstruction of ${name}`}
          title="Cancel"
          onClick={() => void attempt(async () => storeReconstruction(await calls.cancel(job.id)))}
        >
          <Icon name="close" />
        </ActionButton>
      </span>
    </li>
  );
});
