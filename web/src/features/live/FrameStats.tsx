/** Frame counters of a capture, its grade, and device and disk state. */

import type { JSX } from "react";

import type { Capture, Device, System } from "../../shared/api/types";
import { framesSoFar } from "../../shared/state/capture";
import { bytes, count, duration, rate } from "../../shared/state/format";
import { Badge, captureTone, deviceTone, gradeTone, Meter, Panel, Stat, Warnings } from "../../shared/ui/parts";

const CAUSES = ["device", "usb", "ring", "disk"] as const;

export function FrameStats({ capture, rateHz }: { capture: Capture; rateHz: number | null }): JSX.Element {
  const counters = capture.counters;
  const sensor = capture.sensor;
  // The ring counts what was lost before it; what the disk lost is in the recording.
  const onDisk = capture.recording?.lost_by_cause["disk"] ?? 0;
  const lostBy = (cause: string): number =>
    cause === "disk" ? Math.max(onDisk, counters?.lost[cause] ?? 0) : (counters?.lost[cause] ?? 0);
  const lost = CAUSES.reduce((sum, cause) => sum + lostBy(cause), 0);
  const frames = framesSoFar(capture);
  const seconds = frames !== null && sensor !== null ? frames / sensor.frame_rate_hz : null;
  const waits =
    capture.state === "streaming" &&
    counters?.consumers.some((one) => one.policy === "lossless" && one.fill > 0.9) === true;
  const live = capture.state === "streaming" || capture.state === "waiting";
  const gone = live && (counters?.device === "absent" || counters?.device === "lost");
  const badge = gone ? (
    <Badge tone={deviceTone[counters.device]}>{counters.device}</Badge>
  ) : (
    <Badge tone={captureTone[capture.state]}>{capture.state}</Badge>
  );
  return (
    <Panel title="Frames" aside={badge}>
      {capture.state !== "failed" && capture.reason !== "" && (
        <p className="warning" role="status">
          {capture.reason}
        </p>
      )}
      <dl className="stats">
        <Stat name="Received">{counters === null ? "–" : count(counters.received)}</Stat>
        <Stat name="Length">{seconds === null ? "–" : duration(seconds)}</Stat>
        <Stat name="Rate" hint={sensor === null ? undefined : `The camera runs at ${rate(sensor.frame_rate_hz)}`}>
          {rateHz === null ? "–" : rate(rateHz)}
        </Stat>
        <Stat name="Lost">
          {counters === null ? "–" : lost === 0 ? "none" : <b className="problem">{count(lost)}</b>}
        </Stat>
      </dl>
      {counters !== null && (
        <>
          <table className="grid">
            <caption className="hidden">Frames lost, by cause</caption>
            <thead>
              <tr>
                <th scope="col">Lost by</th>
                {CAUSES.map((cause) => (
                  <th key={cause} scope="col" className="number">
                    {cause}
                  </th>
                ))}
              </tr>
            </thead>
            <tbody>
              <tr>
                <th scope="row">frames</th>
                {CAUSES.map((cause) => (
                  <td key={cause} className={`number ${lostBy(cause) > 0 ? "problem" : ""}`}>
                    {count(lostBy(cause))}
                  </td>
                ))}
              </tr>
            </tbody>
          </table>
          {counters.consumers.length > 0 && (
            <table className="grid consumers">
              <caption className="hidden">Consumers of the ring</caption>
              <thead>
                <tr>
                  <th scope="col">Consumer</th>
                  <th scope="col">Ring fill</th>
                  <th scope="col" className="number">
                    Lag
                  </th>
                  <th scope="col" className="number">
                    Missed
                  </th>
                </tr>
              </thead>
              <tbody>
                {counters.consumers.map((one) => {
                  const skips = one.policy === "latest";
                  return (
                    <tr key={one.name}>
                      <th scope="row">
                        {one.name}
                        {one.lagging && !skips && <span className="problem"> lagging</span>}
                      </th>
                      <td>
                        <Meter
                          share={one.fill}
                          label={`Ring fill of ${one.name}`}
                          tone={skips ? "active" : one.lagging ? "problem" : one.fill > 0.8 ? "warning" : "active"}
                        />
                      </td>
                      <td className="number">
                        {sensor === null ? count(one.lag_frames) : duration(one.lag_frames / sensor.frame_rate_hz)}
                      </td>
                      <td
                        className={`number ${one.lost > 0 && !skips ? "problem" : ""}`}
                        title={skips ? "This consumer skips to the newest frames by design" : undefined}
                      >
                        {count(one.lost)}
                        {skips && one.lost > 0 ? " skipped" : ""}
                      </td>
                    </tr>
                  );
                })}
              </tbody>
            </table>
          )}
        </>
      )}
      {waits && (
        <p className="dim note">
          The source waits for the reconstruction: no frames are lost, and the capture runs slower than real time.
        </p>
      )}
      <Warnings texts={capture.warnings} />
    </Panel>
  );
}

/** Grade of the recording, shown when the capture has ended. */
export function VerdictCard({ capture }: { capture: Capture }): JSX.Element | null {
  if (capture.state === "failed")
    return (
      <div className="verdict problem" role="status">
        <Badge tone="problem">failed</Badge>
        <p>{capture.reason}</p>
      </div>
    );
  const verdict = capture.verdict;
  if (verdict == null) return null;
  return (
    <div className={`verdict ${gradeTone[verdict.grade]}`} role="status" data-grade={verdict.grade}>
      <Badge tone={gradeTone[verdict.grade]}>{verdict.grade}</Badge>
      <div>
        {verdict.reasons.length === 0 ? (
          <p>
            No frames lost
            {capture.recording == null
              ? ""
              : `: ${count(capture.recording.frames)} frames, ${bytes(capture.recording.bytes)}`}
            .
          </p>
        ) : (
          verdict.reasons.map((reason) => <p key={reason}>{reason}</p>)
        )}
      </div>
    </div>
  );
}

export function DevicePanel({ device }: { device: Device }): JSX.Element {
  const facts = [device.description, device.kind, device.speed, device.port, device.serial, device.firmware].filter(
    (fact) => fact != null && fact !== "",
  );
  return (
    <div className="device">
      <strong>{device.source}</strong>
      <span className="dim">{facts.join(" · ")}</span>
      {device.reason !== "" && <p className={device.state === "lost" ? "problem" : "dim"}>{device.reason}</p>}
    </div>
  );
}

export function Disk({ system }: { system: System }): JSX.Element {
  const { free_bytes: free, total_bytes: total, recording_s: left, recording_of: camera } = system.disk;
  return (
    <div className="disk">
      <span>Disk</span>
      <Meter share={1 - free / Math.max(total, 1)} label="Disk used" tone={free / total < 0.1 ? "problem" : "active"} />
      <span>
        <b>{bytes(free)}</b> free, {duration(left)} of {camera}
      </span>
    </div>
  );
}
