/** One capture: its recording, its reconstructions, and how they went. */

import { type JSX, useEffect, useState } from "react";

import * as calls from "../api/calls";
import type { Capture, OptionValues, Reconstruction } from "../api/types";
import { lengthOf, nameOf, sourceOf } from "../state/capture";
import { bytes, count, decibel, duration, rate, small, when } from "../state/format";
import { adjust, go, useRoute } from "../state/route";
import {
  isEnded,
  isOver,
  loadReconstructions,
  newestReconstruction,
  takeCapture,
  takeReconstruction,
  useService,
  wordsOf,
} from "../state/store";
import { toast } from "../state/toasts";
import { useAsked } from "../state/useAsked";
import { Icon } from "../ui/icons";
import { Badge, captureTone, Empty, gradeTone, jobTone, Loading, Panel, Stat, Trouble } from "../ui/parts";
import { OptionsForm, textOf } from "./OptionsForm";
import { Plots } from "./Plots";
import { removeWithUndo } from "./remove";

const TRAJECTORIES = [
  { format: "tum", label: "TUM" },
  { format: "kitti", label: "KITTI" },
  { format: "colmap", label: "COLMAP" },
  { format: "nerfstudio", label: "nerfstudio" },
  { format: "json", label: "JSON" },
] as const;

export function CaptureDetail({ id }: { id: string }): JSX.Element {
  const capture = useService((state) => state.captures[id] ?? null);
  const asked = useAsked(id, async () => {
    const [one] = await Promise.all([calls.capture(id), loadReconstructions(id)]);
    takeCapture(one);
    return one;
  });
  if (capture === null)
    return (
      <div className="detail">
        <h1 className="hidden">Capture</h1>
        <button type="button" onClick={() => go({ page: "captures", capture: null, reconstruction: null })}>
          <Icon name="back" /> All captures
        </button>
        {asked.problem === null ? <Loading what="the capture" /> : <Trouble text={asked.problem} again={asked.again} />}
      </div>
    );
  return <Detail capture={capture} />;
}

function Detail({ capture }: { capture: Capture }): JSX.Element {
  const at = useRoute();
  const all = useService((state) => state.reconstructions);
  const jobs = Object.values(all)
    .filter((job) => job.capture_id === capture.id)
    .sort((a, b) => (a.id < b.id ? 1 : -1));
  const job = jobs.find((one) => one.id === at.reconstruction) ?? newestReconstruction(all, capture.id);
  const [otherId, setOtherId] = useState<string | null>(null);
  const other = jobs.find((one) => one.id === otherId && one.id !== job?.id) ?? null;
  const nameOfJob = (one: Reconstruction): string => `#${jobs.length - jobs.indexOf(one)}`;
  const [rerunning, setRerunning] = useState(false);

  const submit = async (options: OptionValues): Promise<void> => {
    try {
      const made = await calls.submit(capture.id, options);
      takeReconstruction(made);
      adjust({ reconstruction: made.id });
      if (job !== null && job.version > 0) setOtherId(job.id);
      setRerunning(false);
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
    }
  };

  return (
    <div className="detail">
      <Head capture={capture} />
      <div className="columns">
        <div>
          <Reconstructions
            jobs={jobs}
            job={job}
            other={other}
            nameOf={nameOfJob}
            onOther={setOtherId}
            onRerun={() => setRerunning(!rerunning)}
            rerunning={rerunning}
            canRun={capture.recording !== null && isOver(capture)}
          />
          {rerunning && <Rerun initial={job?.options ?? {}} onSubmit={submit} onCancel={() => setRerunning(false)} />}
          {job !== null && <Plots capture={capture} job={job} other={other} nameOf={nameOfJob} />}
          {job !== null && <Log job={job} />}
        </div>
        <div>
          <Recording capture={capture} />
          {job !== null && <Result job={job} other={other} nameOf={nameOfJob} />}
          {job !== null && <Options job={job} />}
        </div>
      </div>
    </div>
  );
}

function Head({ capture }: { capture: Capture }): JSX.Element {
  const [name, setName] = useState(capture.name);
  const rename = async (): Promise<void> => {
    if (name === capture.name) return;
    try {
      takeCapture(await calls.changeCapture(capture.id, { name }));
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
      setName(capture.name);
    }
  };
  const keep = async (wanted: boolean): Promise<void> => {
    try {
      takeCapture(await calls.changeCapture(capture.id, { keep: wanted }));
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
    }
  };
  return (
    <header className="head">
      <button type="button" onClick={() => go({ page: "captures", capture: null, reconstruction: null })}>
        <Icon name="back" /> All captures
      </button>
      <h1 className="hidden">{nameOf(capture)}</h1>
      <input
        className="title"
        aria-label="Name of the capture"
        value={name}
        placeholder={sourceOf(capture)}
        maxLength={200}
        onChange={(event) => setName(event.target.value)}
        onBlur={() => void rename()}
        onKeyDown={(event) => {
          if (event.key === "Enter") event.currentTarget.blur();
          if (event.key === "Escape") setName(capture.name);
        }}
      />
      {capture.verdict === null ? (
        <Badge tone={captureTone[capture.state]}>{capture.state}</Badge>
      ) : (
        <Badge tone={gradeTone[capture.verdict.grade]}>{capture.verdict.grade}</Badge>
      )}
      <label className="check" title="Retention leaves it alone">
        <input type="checkbox" checked={capture.keep} onChange={(event) => void keep(event.target.checked)} /> Keep
      </label>
      <button
        type="button"
        onClick={() => go({ page: "scene", capture: capture.id, frame: null, camera: null, ride: false })}
      >
        <Icon name="scene" /> Scene
      </button>
      <button
        type="button"
        onClick={() =>
          void removeWithUndo(
            capture,
            () => go({ page: "captures", capture: null, reconstruction: null }),
            () => go({ page: "captures", capture: capture.id }),
          )
        }
      >
        <Icon name="trash" /> Delete
      </button>
    </header>
  );
}

function Recording({ capture }: { capture: Capture }): JSX.Element {
  const { recording, sensor, verdict } = capture;
  return (
    <Panel title="Recording">
      {verdict !== null && verdict.reasons.length > 0 && (
        <div className={`verdict ${gradeTone[verdict.grade]}`}>
          <div>
            {verdict.reasons.map((reason) => (
              <p key={reason}>{reason}</p>
            ))}
          </div>
        </div>
      )}
      {capture.reason !== "" && <p className={capture.state === "failed" ? "problem" : "dim"}>{capture.reason}</p>}
      {/* The picture of a capture that was not recorded cannot be had; the figures below say so. */}
      {recording !== null && (
        <img className="shot" src={calls.address.thumbnail(capture.id)} alt="A frame of the recording" />
      )}
      <dl className="facts">
        <dt>Started</dt>
        <dd>{when(capture.started_at)}</dd>
        <dt>Source</dt>
        <dd title={capture.source}>{sourceOf(capture)}</dd>
        <dt>Length</dt>
        <dd>
          {lengthOf(capture)}
          {recording !== null && `, ${count(recording.frames)} frames`}
        </dd>
        {sensor !== null && (
          <>
            <dt>Camera</dt>
            <dd>
              {sensor.width} × {sensor.height} at {rate(sensor.frame_rate_hz)}
            </dd>
          </>
        )}
        <dt>Size</dt>
        <dd>{recording === null ? (isOver(capture) ? "not recorded" : "not closed yet") : bytes(recording.bytes)}</dd>
      </dl>
      {recording !== null && (
        <div className="downloads">
          <a className="button" href={calls.address.recording(capture.id)} download>
            <Icon name="download" /> Recording
          </a>
          <a className="button" href={calls.address.sidecar(capture.id)} download>
            <Icon name="download" /> Sidecar
          </a>
        </div>
      )}
    </Panel>
  );
}

function Reconstructions({
  jobs,
  job,
  other,
  nameOf,
  onOther,
  onRerun,
  rerunning,
  canRun,
}: {
  jobs: readonly Reconstruction[];
  job: Reconstruction | null;
  other: Reconstruction | null;
  nameOf: (job: Reconstruction) => string;
  onOther: (id: string | null) => void;
  onRerun: () => void;
  rerunning: boolean;
  canRun: boolean;
}): JSX.Element {
  const cancel = async (id: string): Promise<void> => {
    try {
      takeReconstruction(await calls.cancel(id));
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
    }
  };
  return (
    <Panel
      title="Reconstructions"
      aside={
        <button
          type="button"
          aria-expanded={rerunning}
          disabled={!canRun}
          title={canRun ? undefined : "Needs a recording that is complete"}
          onClick={onRerun}
        >
          <Icon name="again" /> {jobs.length === 0 ? "Reconstruct" : "Re-run with other options"}
        </button>
      }
    >
      {jobs.length === 0 ? (
        <Empty icon="scene" title="None yet" />
      ) : (
        <div className="scroll" role="region" aria-label="Table of reconstructions" tabIndex={0}>
          <table className="grid jobs">
            <thead>
              <tr>
                <th scope="col">Show</th>
                <th scope="col">Compare</th>
                <th scope="col">Begun</th>
                <th scope="col">State</th>
                <th scope="col" className="number">
                  Poses
                </th>
                <th scope="col" className="number">
                  Splats
                </th>
                <th scope="col" className="number">
                  PSNR
                </th>
                <th scope="col">
                  <span className="hidden">Actions</span>
                </th>
              </tr>
            </thead>
            <tbody>
              {jobs.map((one) => {
                const name = `reconstruction ${nameOf(one)}`;
                return (
                  <tr key={one.id}>
                    <td>
                      <input
                        type="radio"
                        name="shown"
                        aria-label={`Show the ${name}`}
                        checked={one.id === job?.id}
                        onChange={() => adjust({ reconstruction: one.id })}
                      />
                    </td>
                    <td>
                      <input
                        type="checkbox"
                        aria-label={`Compare with the ${name}`}
                        disabled={one.id === job?.id}
                        checked={one.id === other?.id}
                        onChange={(event) => onOther(event.target.checked ? one.id : null)}
                      />
                    </td>
                    <td>
                      {nameOf(one)} {when(one.created_at)} {one.live && <span className="dim">live</span>}
                    </td>
                    <td>
                      <Badge tone={jobTone[one.state]}>
                        {one.state === "running" ? `${one.stage} ${Math.round(100 * one.progress)} %` : one.state}
                      </Badge>
                      {one.reason !== "" && <span className="dim reason">{one.reason}</span>}
                    </td>
                    <td className="number">{count(one.poses)}</td>
                    <td className="number">{count(one.splats)}</td>
                    <td className="number">{decibel(one.psnr_db)}</td>
                    <td className="number">
                      {isEnded(one) ? (
                        <button
                          type="button"
                          className="bare"
                          disabled={one.version === 0}
                          aria-label={`Scene of the ${name}`}
                          onClick={() =>
                            go({
                              page: "scene",
                              capture: one.capture_id,
                              reconstruction: one.id,
                              frame: null,
                              camera: null,
                              ride: false,
                            })
                          }
                        >
                          <Icon name="scene" />
                        </button>
                      ) : (
                        <button type="button" onClick={() => void cancel(one.id)}>
                          Cancel
                        </button>
                      )}
                    </td>
                  </tr>
                );
              })}
            </tbody>
          </table>
        </div>
      )}
    </Panel>
  );
}

function Rerun({
  initial,
  onSubmit,
  onCancel,
}: {
  initial: OptionValues;
  onSubmit: (values: OptionValues) => Promise<void>;
  onCancel: () => void;
}): JSX.Element {
  const schema = useAsked("options", calls.optionSchema);
  return (
    <Panel title="Options of the new reconstruction">
      {schema.problem !== null && <Trouble text={schema.problem} again={schema.again} />}
      {schema.value === null ? (
        schema.loading && <Loading what="the options" />
      ) : (
        <OptionsForm schema={schema.value} initial={initial} onSubmit={onSubmit} onCancel={onCancel} />
      )}
    </Panel>
  );
}

function Result({
  job,
  other,
  nameOf: name,
}: {
  job: Reconstruction;
  other: Reconstruction | null;
  nameOf: (job: Reconstruction) => string;
}): JSX.Element {
  const took = (one: Reconstruction): string =>
    one.started_at === null || one.ended_at === null
      ? "–"
      : duration((Date.parse(one.ended_at) - Date.parse(one.started_at)) / 1000);
  const facts: [string, (one: Reconstruction) => string][] = [
    ["Poses", (one) => count(one.poses)],
    ["Splats", (one) => count(one.splats)],
    ["PSNR", (one) => decibel(one.psnr_db)],
    ["Loss", (one) => small(one.loss)],
    ["Took", took],
  ];
  const ready = job.version > 0;
  return (
    <Panel title="Result">
      {other === null ? (
        <dl className="stats">
          {facts.map(([name, value]) => (
            <Stat key={name} name={name}>
              {value(job)}
            </Stat>
          ))}
        </dl>
      ) : (
        <table className="grid compared">
          <thead>
            <tr>
              <td />
              <th scope="col" className="number">
                {name(job)}
              </th>
              <th scope="col" className="number">
                {name(other)}
              </th>
            </tr>
          </thead>
          <tbody>
            {facts.map(([name, value]) => (
              <tr key={name}>
                <th scope="row">{name}</th>
                <td className="number">{value(job)}</td>
                <td className="number">{value(other)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {ready ? (
        <>
          <div className="downloads" role="group" aria-label="Scene">
            <a className="button" href={calls.address.scene(job.id, "ply")} download>
              <Icon name="download" /> PLY
            </a>
            <a className="button" href={calls.address.scene(job.id, "spz")} download>
              <Icon name="download" /> SPZ
            </a>
          </div>
          <div className="downloads" role="group" aria-label="Trajectory">
            {TRAJECTORIES.map(({ format, label }) => (
              <a key={format} className="button" href={calls.address.trajectory(job.id, format)} download>
                {label}
              </a>
            ))}
          </div>
        </>
      ) : (
        <p className="dim">There is no scene to download yet.</p>
      )}
    </Panel>
  );
}

function Options({ job }: { job: Reconstruction }): JSX.Element {
  const entries = Object.entries(job.options);
  return (
    <Panel title="Options used">
      <dl className="facts">
        {entries.map(([key, value]) => (
          <div key={key}>
            <dt>{key.replaceAll("_", " ")}</dt>
            <dd>{textOf(value) === "" ? "default" : textOf(value)}</dd>
          </div>
        ))}
      </dl>
    </Panel>
  );
}

function Log({ job }: { job: Reconstruction }): JSX.Element {
  const [open, setOpen] = useState(false);
  const log = useAsked(open ? job.id : null, () => calls.log(job.id));
  const { again } = log;
  const ended = isEnded(job);
  useEffect(() => {
    if (!open || ended) return;
    const timer = setInterval(again, 2000);
    return () => {
      clearInterval(timer);
      again(); // what came between the last look and the end
    };
  }, [open, ended, again]);
  return (
    <details className="panel log" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Log</summary>
      {log.problem !== null && <Trouble text={log.problem} again={log.again} />}
      {log.value !== null && (
        <pre tabIndex={0} aria-label="Log">
          {log.value === "" ? "The log is empty." : log.value}
        </pre>
      )}
      {log.loading && log.value === null && <Loading what="the log" />}
    </details>
  );
}
