/** Name and notes of a reconstruction, saved when the field is left. */

import type { JSX } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction, ReconstructionChange } from "../../shared/api/types";
import { useDenied } from "../../shared/state/access";
import { attempt } from "../../shared/state/attempt";
import { storeReconstruction } from "../../shared/state/store";
import { useDraft } from "../../shared/state/useDraft";
import { Panel } from "../../shared/ui/parts";

export function ReconstructionTexts({ job, number }: { job: Reconstruction; number: string }): JSX.Element {
  const readOnly = useDenied("operate") !== null;
  const save = (change: ReconstructionChange): Promise<boolean> =>
    attempt(async () => storeReconstruction(await calls.changeReconstruction(job.id, change)));
  const name = useDraft(job.name, (text) => save({ name: text }));
  const notes = useDraft(job.notes, (text) => save({ notes: text }));
  return (
    <Panel title={`Reconstruction ${number}`}>
      <label className="tags">
        Name
        <input
          aria-label="Name of the reconstruction"
          placeholder="2,000 steps"
          maxLength={200}
          readOnly={readOnly}
          {...name}
        />
      </label>
      <textarea
        className="notes"
        aria-label="Notes on the reconstruction"
        placeholder="Notes"
        rows={Math.min(12, Math.max(2, notes.value.split("\n").length))}
        maxLength={20000}
        readOnly={readOnly}
        {...notes}
      />
    </Panel>
  );
}
