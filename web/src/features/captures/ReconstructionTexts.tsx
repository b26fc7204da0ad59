/** Name and notes of a reconstruction, saved when the field is left. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction, ReconstructionChange } from "../../shared/api/types";
import { useDenied } from "../../shared/state/access";
import { attempt } from "../../shared/state/attempt";
import { storeReconstruction } from "../../shared/state/store";
import { Panel } from "../../shared/ui/parts";

export function ReconstructionTexts({ job, number }: { job: Reconstruction; number: string }): JSX.Element {
  const [name, setName] = useState(job.name);
  const [notes, setNotes] = useState(job.notes);
  const readOnly = useDenied("operate") !== null;
  const save = (change: ReconstructionChange): Promise<boolean> =>
    attempt(async () => storeReconstruction(await calls.changeReconstruction(job.id, change)));
  return (
    <Panel title={`Reconstruction ${number}`}>
      <label className="tags">
        Name
        <input
          aria-label="Name of the reconstruction"
          value={name}
          placeholder="2,000 steps"
          maxLength={200}
          readOnly={readOnly}
          onChange={(event) => setName(event.target.value)}
          onBlur={() => {
            if (name !== job.name) void save({ name });
          }}
          onKeyDown={(event) => {
            if (event.key === "Enter") event.currentTarget.blur();
          }}
        />
      </label>
      <textarea
        className="notes"
        aria-label="Notes on the reconstruction"
        placeholder="Notes"
        value={notes}
        rows={Math.min(12, Math.max(2, notes.split("\n").length))}
        maxLength={20000}
        readOnly={readOnly}
        onChange={(event) => setNotes(event.target.value)}
        onBlur={() => {
          if (notes !== job.notes) void save({ notes });
        }}
      />
    </Panel>
  );
}
