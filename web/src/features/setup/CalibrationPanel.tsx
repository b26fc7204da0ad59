/** Dark rates and gains of a camera: what is known, and the steps that measure them. */

import { type JSX, useEffect, useRef, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Calibrated, Capture, Device } from "../../shared/api/types";
import { percent } from "../../shared/state/format";
import { errorText } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { Badge, ErrorMessage } from "../../shared/ui/parts";

const SECONDS = 1;
const POLL_MS = 400;
const PICTURES = [
  { kind: "dark", label: "Dark rate" },
  { kind: "gain", label: "Gain" },
  { kind: "useless", label: "Dead and hot pixels" },
] as const;
const STEPS = [
  { key: "dark", label: "Record the dark", what: "Cover the lens completely.", name: "dark frames" },
  {
    key: "flat",
    label: "Record the light",
    what: "Uncover it, and point it at something even and bright, out of focus: a white wall, or paper before the lens. Leave this out to measure dark rates and hot pixels only.",
    name: "even light",
  },
] as const;

type StepKey = (typeof STEPS)[number]["key"];
type Taken = Partial<Record<StepKey, string>>;

export function CalibrationPanel({
  device,
  file,
  onChange,
}: {
  device: Device;
  /** The calibration that captures are made with. */
  file: string | null;
  onChange: () => void;
}): JSX.Element {
  const [taken, setTaken] = useState<Taken>({});
  const [recording, setRecording] = useState<StepKey | null>(null);
  const [measuring, setMeasuring] = useState(false);
  const [result, setResult] = useState<Calibrated["measured"] | null>(null);
  const [problem, setProblem] = useState<string | null>(null);
  const open = useRef(true);
  useEffect(() => {
    open.current = true;
    return () => {
      open.current = false;
    };
  }, []);

  const record = async (key: StepKey, name: string): Promise<void> => {
    setRecording(key);
    setProblem(null);
    try {
      const plan = { source: device.source, seconds: SECONDS, record: true, reconstruct: false };
      const capture = await ended(await calls.startCapture({ ...plan, name: `${name} of ${device.id}`.slice(0, 120) }));
      if (capture.state === "failed") throw new Error(capture.reason);
      setTaken((old) => ({ ...old, [key]: capture.id }));
    } catch (error) {
      setProblem(errorText(error));
    }
    setRecording(null);
  };
  /** The capture when it is over, or as it is when the page is left. */
  const ended = async (capture: Capture): Promise<Capture> => {
    while (open.current && capture.state !== "complete" && capture.state !== "failed") {
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      capture = await calls.capture(capture.id);
    }
    return capture;
  };
  const measure = async (): Promise<void> => {
    setMeasuring(true);
    setProblem(null);
    try {
      const { measured } = await calls.calibrate(device.id, { dark: taken.dark ?? null, flat: taken.flat ?? null });
      setResult(measured);
      setTaken({});
      onChange();
    } catch (error) {
      setProblem(errorText(error));
    }
    setMeasuring(false);
  };

  const busy = recording !== null || measuring || device.capture_id !== null;
  const ready = taken.dark !== undefined || taken.flat !== undefined;
  return (
    <section className="calibration" aria-label="Calibration">
      <h3>Calibration</h3>
      {file === null ? (
        <p>Dark rates, gains and defects of this camera are not known: its pictures have fixed noise.</p>
      ) : (
        <Pictures key={file} device={device} file={file} />
      )}
      <ol>
        {STEPS.map((step) => (
          <li key={step.key}>
            <p>{step.what}</p>
            <ActionButton disabled={busy} onClick={() => void record(step.key, step.name)}>
              {recording === step.key ? "Recording…" : step.label}
            </ActionButton>{" "}
            {taken[step.key] !== undefined && <Badge tone="good">recorded</Badge>}
          </li>
        ))}
        <li>
          <ActionButton className="primary" disabled={busy || !ready} onClick={() => void measure()}>
            {measuring ? "Measuring…" : "Measure"}
          </ActionButton>
        </li>
      </ol>
      {problem !== null && <ErrorMessage text={problem} />}
      {result !== null && (
        <p role="status">
          {result.useless} of {result.pixels} pixels are dead or hot and will be left out; dark rate{" "}
          {result.dark_rate.toFixed(4)} spikes a frame; gains differ by {percent(result.gain_spread)}.
        </p>
      )}
    </section>
  );
}

function Pictures({ device, file }: { device: Device; file: string }): JSX.Element {
  return (
    <div className="maps">
      {PICTURES.map(({ kind, label }) => (
        <figure key={kind}>
          <img src={calls.address.calibration(device.id, kind, file)} alt={`${label} of each pixel`} />
          <figcaption>{label}</figcaption>
        </figure>
      ))}
    </div>
  );
}
