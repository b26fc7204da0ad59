/** The form for jobs that use maps: extend one by the recording, localise the recording in one, merge two. */

import { type JSX, type SubmitEvent, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction } from "../../shared/api/types";
import { nameOf } from "../../shared/state/capture";
import { count, when } from "../../shared/state/format";
import { useService } from "../../shared/state/store";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { Empty, Labelled, Panel } from "../../shared/ui/parts";

export type MapTask = "localise" | "extend" | "merge";

/** Finished reconstructions that can be used as maps. */
export const mapsOf = (jobs: readonly Reconstruction[]): Reconstruction[] =>
  jobs.filter((one) => one.task !== "localise" && one.version > 0);

export function MapPanel({
  shown,
  canRead,
  onSubmit,
  onCancel,
}: {
  /** The reconstruction that another one is merged with. */
  shown: Reconstruction | null;
  /** Whether there is a complete recording. */
  canRead: boolean;
  onSubmit: (task: MapTask, mapId: string) => Promise<void>;
  onCancel: () => void;
}): JSX.Element {
  const found = useFetch("maps", calls.complete);
  return (
    <Panel title="Use a map">
      <Fetched from={found} what="the maps">
        {(jobs) => <Form maps={mapsOf(jobs)} shown={shown} canRead={canRead} onSubmit={onSubmit} onCancel={onCancel} />}
      </Fetched>
    </Panel>
  );
}

function Form({
  maps,
  shown,
  canRead,
  onSubmit,
  onCancel,
}: {
  maps: Reconstruction[];
  shown: Reconstruction | null;
  canRead: boolean;
  onSubmit: (task: MapTask, mapId: string) => Promise<void>;
  onCancel: () => void;
}): JSX.Element {
  const captures = useService((state) => state.captures);
  const canMerge = shown !== null && mapsOf([shown]).length === 1;
  const [task, setTask] = useState<MapTask>(canRead ? "localise" : "merge");
  const choices = task === "merge" ? maps.filter((one) => one.id !== shown?.id) : maps;
  const [wanted, setWanted] = useState("");
  const [busy, setBusy] = useState(false);
  const chosen = choices.find((one) => one.id === wanted) ?? choices[0];
  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    if (chosen === undefined) return;
    setBusy(true);
    void onSubmit(task, chosen.id).finally(() => setBusy(false));
  };
  const label = (one: Reconstruction): string => {
    const capture = captures[one.capture_id];
    return `${capture === undefined ? one.capture_id : nameOf(capture)}, ${when(one.created_at)}, ${count(one.splats)} splats`;
  };
  return (
    <form className="options" onSubmit={submit}>
      <Labelled label="what to do" hint="Both have to show the same place.">
        {(called) => (
          <select {...called} value={task} onChange={(event) => setTask(event.target.value as MapTask)}>
            <option value="localise" disabled={!canRead}>
              Find this recording in a map
            </option>
            <option value="extend" disabled={!canRead}>
              Extend a map by this recording
            </option>
            <option value="merge" disabled={!canMerge}>
              Merge the shown reconstruction with a map
            </option>
          </select>
        )}
      </Labelled>
      {chosen === undefined ? (
        <Empty icon="scene" title="No map" />
      ) : (
        <Labelled
          label="map"
          hint={
            task === "merge"
              ? "The result is in the frame of reference of the shown reconstruction."
              : "The result is in the frame of reference of the map."
          }
        >
          {(called) => (
            <select {...called} value={chosen.id} onChange={(event) => setWanted(event.target.value)}>
              {choices.map((one) => (
                <option key={one.id} value={one.id}>
                  {label(one)}
                </option>
              ))}
            </select>
          )}
        </Labelled>
      )}
      <div className="buttons">
        <button
          type="submit"
          className="primary"
          disabled={busy || chosen === undefined || (task === "merge" && !canMerge)}
        >
          Start
        </button>
        <button type="button" onClick={onCancel}>
          Cancel
        </button>
      </div>
    </form>
  );
}
