/** One capture: recording, notes, reconstructions, plots, downloads. */

import { type JSX, useState } from "react";
import { useShallow } from "zustand/react/shallow";

import * as calls from "../../shared/api/calls";
import type { Capture, CaptureChange, Reconstruction } from "../../shared/api/types";
import { useDenied } from "../../shared/state/access";
import { attempt } from "../../shared/state/attempt";
import { nameOf, numberOf } from "../../shared/state/capture";
import { adjust, go, useRoute } from "../../shared/state/route";
import {
  isFinished,
  loadCapture,
  loadReconstructions,
  newestReconstruction,
  storeCapture,
  storeReconstruction,
  useService,
} from "../../shared/state/store";
import { useDraft } from "../../shared/state/useDraft";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton, ScopeNote } from "../../shared/ui/access";
import { Icon } from "../../shared/ui/icons";
import { CaptureBadge, ErrorMessage, Loading, Panel } from "../../shared/ui/parts";
import { MapPanel, type MapTask } from "./MapPanel";
import { Plots } from "./Plots";
import { ReconstructionsPanel } from "./ReconstructionsPanel";
import { RecordingPanel } from "./RecordingPanel";
import { removeWithUndo } from "./remove";
import { RerunPanel } from "./RerunPanel";
import { ReconstructionTexts } from "./ReconstructionTexts";
import { LogPanel, OptionsPanel, ResultPanel } from "./ResultPanel";

export function CaptureDetail({ id }: { id: string }): JSX.Element {
  const capture = useService((state) => state.captures[id] ?? null);
  const refreshed = useService((state) => state.refreshed);
  const fetched = useFetch(`${id} ${String(refreshed)}`, () => Promise.all([loadCapture(id), loadReconstructions(id)]));
  if (capture === null)
    return (
      <div className="detail">
        <h1 className="hidden">Capture</h1>
        <button type="button" onClick={() => go({ page: "captures", capture: null, reconstruction: null })}>
          <Icon name="back" /> All captures
        </button>
        {fetched.problem === null ? (
          <Loading what="the capture" />
        ) : (
          <ErrorMessage text={fetched.problem} again={fetched.again} />
        )}
      </div>
    );
  return <Detail capture={capture} />;
}

function Detail({ capture }: { capture: Capture }): JSX.Element {
  const at = useRoute();
  // Jobs of other captures change all the time: the page is drawn anew only for its own.
  const jobs = useService(
    useShallow(({ reconstructions }) =>
      Object.values(reconstructions)
        .filter((job) => job.capture_id === capture.id)
        .sort((a, b) => (a.id < b.id ? 1 : -1)),
    ),
  );
  const newest = useService((state) => newestReconstruction(state.reconstructions, capture.id));
  const job = jobs.find((one) => one.id === at.reconstruction) ?? newest;
  const [otherId, setOtherId] = useState<string | null>(null);
  const other = jobs.find((one) => one.id === otherId && one.id !== job?.id) ?? null;
  const nameOfJob = (one: Reconstruction): string => numberOf(one, jobs, capture.reconstruction_count);
  const [form, setForm] = useState<"rerun" | "map" | null>(null);
  const toggle = (wanted: "rerun" | "map"): void => setForm(form === wanted ? null : wanted);

  const start = async (begin: () => Promise<Reconstruction>): Promise<void> => {
    await attempt(async () => {
      const made = await begin();
      storeReconstruction(made);
      adjust({ reconstruction: made.id });
      if (made.task === "reconstruct" && job !== null && job.version > 0) setOtherId(job.id);
      setForm(null);
    });
  };
  const withMap = (task: MapTask, mapId: string): Promise<void> =>
    start(() =>
      task === "localise"
        ? calls.localise(mapId, capture.id)
        : task === "extend"
          ? calls.submit(capture.id, job?.options ?? {}, mapId)
          : calls.merge(job?.id ?? "", mapId),
    );

  const canRun = capture.recording !== null && isFinished(capture);
  return (
    <div className="detail">
      <Head key={capture.id} capture={capture} />
      <ScopeNote />
      <div className="columns">
        <div>
          <ReconstructionsPanel
            jobs={jobs}
            job={job}
            other={other}
            nameOf={nameOfJob}
            onOther={setOtherId}
            onRerun={() => toggle("rerun")}
            rerunning={form === "rerun"}
            onMap={() => toggle("map")}
            mapping={form === "map"}
            canRun={canRun}
            total={Math.max(capture.reconstruction_count, jobs.length)}
            onMore={(before) => void attempt(() => loadReconstructions(capture.id, before))}
          />
          {form === "rerun" && (
            <RerunPanel
              initial={job?.options ?? {}}
              jobs={jobs}
              nameOf={nameOfJob}
              onSubmit={(options, given) => start(() => calls.submit(capture.id, options, null, given))}
              onCancel={() => setForm(null)}
            />
          )}
          {form === "map" && (
            <MapPanel shown={job} canRead={canRun} onSubmit={withMap} onCancel={() => setForm(null)} />
          )}
          {job !== null && measured(job) && <Plots capture={capture} job={job} other={other} nameOf={nameOfJob} />}
          {job !== null && <LogPanel job={job} />}
        </div>
        <div>
          <RecordingPanel capture={capture} />
          <Notes key={capture.id} capture={capture} />
          {job !== null && <ReconstructionTexts key={job.id} job={job} number={nameOfJob(job)} />}
          {job !== null && <ResultPanel job={job} other={other} nameOf={nameOfJob} />}
          {job !== null && <OptionsPanel job={job} />}
        </div>
      </div>
    </div>
  );
}

/** Whether its tracking and its loss were noted over time. */
const measured = (job: Reconstruction): boolean => job.task === "reconstruct" || job.task === "extend";

const change = (capture: Capture, values: CaptureChange): Promise<boolean> =>
  attempt(async () => storeCapture(await calls.changeCapture(capture.id, values)));

function Head({ capture }: { capture: Capture }): JSX.Element {
  const readOnly = useDenied("operate");
  const name = useDraft(capture.name, (text) => change(capture, { name: text }));
  return (
    <header className="head">
      <button type="button" onClick={() => go({ page: "captures", capture: null, reconstruction: null })}>
        <Icon name="back" /> All captures
      </button>
      <h1 className="hidden">{nameOf(capture)}</h1>
      <input
        className="title"
        aria-label="Name of the capture"
        placeholder={nameOf({ ...capture, name: "" })}
        maxLength={200}
        readOnly={readOnly !== null}
        {...name}
      />
      <CaptureBadge capture={capture} />
      <label className="check" title={readOnly ?? "Exclude from automatic removal"}>
        <input
          type="checkbox"
          checked={capture.keep}
          disabled={readOnly !== null}
          onChange={(event) => void change(capture, { keep: event.target.checked })}
        />{" "}
        Keep
      </label>
      <button
        type="button"
        onClick={() => go({ page: "scene", capture: capture.id, frame: null, camera: null, ride: false })}
      >
        <Icon name="scene" /> Scene
      </button>
      <ActionButton
        onClick={() =>
          void removeWithUndo(
            capture,
            () => go({ page: "captures", capture: null, reconstruction: null }),
            () => go({ page: "captures", capture: capture.id }),
          )
        }
      >
        <Icon name="trash" /> Delete
      </ActionButton>
    </header>
  );
}

/** Words of a text, separated by commas; each once. */
const tagsOf = (text: string): string[] => [
  ...new Set(
    text
      .split(",")
      .map((word) => word.trim())
      .filter((word) => word !== ""),
  ),
];

function Notes({ capture }: { capture: Capture }): JSX.Element {
  const notes = useDraft(capture.notes, (text) => change(capture, { notes: text }));
  const tags = useDraft(capture.tags.join(", "), async (text) => {
    const wanted = tagsOf(text);
    return wanted.join() === capture.tags.join() || change(capture, { tags: wanted });
  });
  const noted = Object.entries(capture.metadata);
  const readOnly = useDenied("operate") !== null;
  return (
    <Panel title="Notes">
      <textarea
        className="notes"
        aria-label="Notes on the capture"
        placeholder="Notes; included in the search"
        rows={Math.min(12, Math.max(2, notes.value.split("\n").length))}
        maxLength={20000}
        readOnly={readOnly}
        {...notes}
      />
      <label className="tags">
        Tags
        <input placeholder="desk, night" maxLength={1000} readOnly={readOnly} {...tags} />
      </label>
      {noted.length > 0 && (
        <dl className="facts">
          {noted.map(([key, value]) => (
            <div key={key}>
              <dt>{key}</dt>
              <dd>{value}</dd>
            </div>
          ))}
        </dl>
      )}
    </Panel>
  );
}
