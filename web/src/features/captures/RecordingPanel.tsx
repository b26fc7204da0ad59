/** The recording of a capture: grade, length, camera, downloads. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Capture } from "../../shared/api/types";
import { lengthOf, sourceOf } from "../../shared/state/capture";
import { bytes, count, rate, when } from "../../shared/state/format";
import { isFinished } from "../../shared/state/store";
import { Icon } from "../../shared/ui/icons";
import { gradeTone, Panel, Warnings } from "../../shared/ui/parts";
import { SlowMotion, usePace } from "../../shared/ui/SlowMotion";

export function RecordingPanel({ capture }: { capture: Capture }): JSX.Element {
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
      <Warnings texts={capture.warnings} />
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
        <dd>
          {recording === null ? (isFinished(capture) ? "not recorded" : "not closed yet") : bytes(recording.bytes)}
        </dd>
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
      {recording !== null && <SlowMotionTool capture={capture} />}
    </Panel>
  );
}

function SlowMotionTool({ capture }: { capture: Capture }): JSX.Element {
  const [open, setOpen] = useState(false);
  const pace = usePace();
  return (
    <details className="tool" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Video in slow motion</summary>
      {open && <SlowMotion capture={capture} pace={pace} />}
    </details>
  );
}
