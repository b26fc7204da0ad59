/** The result of a reconstruction: figures, downloads, the options it was run with, and its log. */

import { type JSX, useEffect, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction } from "../../shared/api/types";
import { count, decibel, duration, small } from "../../shared/state/format";
import { isEnded } from "../../shared/state/store";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { Panel, Stat } from "../../shared/ui/parts";
import { textOf } from "../../shared/ui/options";
import { ExportMenu } from "./ExportMenu";

const TRAJECTORIES = [
  { format: "tum", label: "TUM" },
  { format: "kitti", label: "KITTI" },
  { format: "colmap", label: "COLMAP" },
  { format: "nerfstudio", label: "nerfstudio" },
  { format: "json", label: "JSON" },
] as const;

export function ResultPanel({
  job,
  other,
  nameOf,
}: {
  job: Reconstruction;
  other: Reconstruction | null;
  nameOf: (job: Reconstruction) => string;
}): JSX.Element {
  const durationOf = (one: Reconstruction): string =>
    one.started_at === null || one.ended_at === null
      ? "–"
      : duration((Date.parse(one.ended_at) - Date.parse(one.started_at)) / 1000);
  const facts: [string, (one: Reconstruction) => string][] = [
    ["Poses", (one) => count(one.poses)],
    ["Splats", (one) => count(one.splats)],
    ["PSNR", (one) => decibel(one.psnr_db)],
    ["Loss", (one) => small(one.loss)],
    ["Duration", durationOf],
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
                {nameOf(job)}
              </th>
              <th scope="col" className="number">
                {nameOf(other)}
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
          <div className="downloads" role="group" aria-label="Report">
            <a className="button" href={calls.address.report(job.id)} target="_blank" rel="noopener">
              Report
            </a>
            <a className="button" href={calls.address.bundle(job.id)} download>
              <Icon name="download" /> All as ZIP
            </a>
          </div>
          <div className="downloads" role="group" aria-label="Scene">
            <a className="button" href={calls.address.scene(job.id, "ply")} download>
              <Icon name="download" /> PLY
            </a>
            <a className="button" href={calls.address.scene(job.id, "spz")} download>
              <Icon name="download" /> SPZ
            </a>
          </div>
          <ExportMenu job={job} />
          <div className="downloads" role="group" aria-label="Path alone">
            <span className="dim">Path alone</span>
            {TRAJECTORIES.map(({ format, label }) => (
              <a key={format} className="button" href={calls.address.trajectory(job.id, format)} download>
                <Icon name="download" /> {label}
              </a>
            ))}
          </div>
        </>
      ) : (
        <p className="dim">No scene to download yet.</p>
      )}
    </Panel>
  );
}

export function OptionsPanel({ job }: { job: Reconstruction }): JSX.Element {
  const entries = Object.entries({
    ...job.options,
    poses: job.poses_from === "" ? "estimated" : job.poses_from === "file" ? "of a file" : `of ${job.poses_from}`,
    calibration: job.calibration_from === "" ? "of the recording" : `of ${job.calibration_from}`,
  });
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

export function LogPanel({ job }: { job: Reconstruction }): JSX.Element {
  const [open, setOpen] = useState(false);
  const log = useFetch(open ? job.id : null, () => calls.log(job.id));
  const { again } = log;
  const ended = isEnded(job);
  useEffect(() => {
    if (!open || ended) return;
    const timer = setInterval(again, 2000);
    return () => {
      clearInterval(timer);
      again(); // lines between the last request and the end
    };
  }, [open, ended, again]);
  return (
    <details className="panel log" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Log</summary>
      <Fetched from={log} what="the log">
        {(text) => (
          <pre tabIndex={0} aria-label="Log">
            {text === "" ? "The log is empty." : text}
          </pre>
        )}
      </Fetched>
    </details>
  );
}
