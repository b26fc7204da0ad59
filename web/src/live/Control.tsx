/** Start, stop and what to do with the frames. */

import { type JSX, type SubmitEvent, useId, useState } from "react";

import { startCapture, stopCapture } from "../api/calls";
import type { Capture, CaptureRequest, Device } from "../api/types";
import { adjust } from "../state/route";
import { isOver, takeCapture, useService, wordsOf } from "../state/store";
import { Icon } from "../ui/icons";
import { Badge, deviceTone, Panel, Trouble } from "../ui/parts";

type Length = "open" | "seconds" | "frames";
const OTHER = "(other)";

/** The request for a capture, from what the form says. */
export function planOf(form: {
  source: string;
  length: Length;
  amount: string;
  name: string;
  record: boolean;
  reconstruct: boolean;
}): CaptureRequest {
  const amount = Number(form.amount);
  const limited = Number.isFinite(amount) && amount > 0;
  return {
    source: form.source,
    ...(form.length === "seconds" && limited ? { seconds: amount } : {}),
    ...(form.length === "frames" && limited ? { frames: Math.round(amount) } : {}),
    ...(form.name.trim() === "" ? {} : { name: form.name.trim() }),
    record: form.record,
    reconstruct: form.reconstruct,
  };
}

export function Control({ capture }: { capture: Capture | null }): JSX.Element {
  const devices = useService((state) => state.devices);
  const [chosen, setChosen] = useState<string | null>(null);
  const [other, setOther] = useState("replay:");
  const [length, setLength] = useState<Length>("open");
  const [amount, setAmount] = useState("0.1");
  const [name, setName] = useState("");
  const [record, setRecord] = useState(true);
  const [reconstruct, setReconstruct] = useState(true);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<string | null>(null);
  const ids = useId();
  const running = capture !== null && !isOver(capture);
  const selected = chosen ?? devices[0]?.source ?? OTHER;
  const device = devices.find((one) => one.source === selected) ?? null;

  const act = async (action: () => Promise<Capture>): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      takeCapture(await action());
    } catch (error) {
      setProblem(wordsOf(error));
    }
    setBusy(false);
  };
  const start = (event: SubmitEvent): void => {
    event.preventDefault();
    adjust({ capture: null, reconstruction: null, frame: null });
    const source = selected === OTHER ? other : selected;
    void act(() => startCapture(planOf({ source, length, amount, name, record, reconstruct })));
  };

  return (
    <Panel title="Capture" aside={device !== null && <DeviceSign device={device} />}>
      <form className="control" onSubmit={start}>
        <label htmlFor={`${ids}-source`}>Device</label>
        <select
          id={`${ids}-source`}
          value={selected}
          disabled={running}
          onChange={(event) => setChosen(event.target.value)}
        >
          {devices.map((one) => (
            <option key={one.source} value={one.source}>
              {one.source} · {one.description}
            </option>
          ))}
          <option value={OTHER}>Another source…</option>
        </select>
        {selected === OTHER && (
          <>
            <label htmlFor={`${ids}-other`}>Source</label>
            <input
              id={`${ids}-other`}
              value={other}
              disabled={running}
              spellCheck={false}
              autoComplete="off"
              placeholder="replay:/path/recording.dat"
              aria-describedby={`${ids}-sources`}
              onChange={(event) => setOther(event.target.value)}
            />
            <p id={`${ids}-sources`} className="dim note">
              <code>replay:FILE</code> plays a recording, <code>usb0?fov=40</code> is a camera, <code>sim:</code> a
              simulated one
            </p>
          </>
        )}
        <label htmlFor={`${ids}-name`}>Name</label>
        <input
          id={`${ids}-name`}
          value={name}
          disabled={running}
          maxLength={120}
          autoComplete="off"
          placeholder="optional"
          onChange={(event) => setName(event.target.value)}
        />
        <label htmlFor={`${ids}-length`}>Length</label>
        <span className="pair">
          <select
            id={`${ids}-length`}
            value={length}
            disabled={running}
            onChange={(event) => setLength(event.target.value as Length)}
          >
            <option value="open">until stopped</option>
            <option value="seconds">seconds</option>
            <option value="frames">frames</option>
          </select>
          {length !== "open" && (
            <input
              type="number"
              aria-label={`Length in ${length}`}
              min={length === "frames" ? 1 : 0.001}
              step="any"
              value={amount}
              disabled={running}
              required
              onChange={(event) => setAmount(event.target.value)}
            />
          )}
        </span>
        <span className="checks">
          <label
            className="check"
            title="Keep the frames on disk: for downloads, another reconstruction, pictures of any moment"
          >
            <input
              type="checkbox"
              checked={record}
              disabled={running}
              onChange={(event) => setRecord(event.target.checked)}
            />
            Record
          </label>
          <label className="check" title="Follow the camera and let the scene grow while it runs">
            <input
              type="checkbox"
              checked={reconstruct}
              disabled={running}
              onChange={(event) => setReconstruct(event.target.checked)}
            />
            Reconstruct
          </label>
        </span>
        <span className="buttons">
          <button
            type="submit"
            className="primary"
            disabled={running || busy}
            title={running ? "One capture at a time: this one is not over yet" : undefined}
          >
            <Icon name="start" /> Start
          </button>
          <button
            type="button"
            disabled={!running || busy}
            onClick={() => capture !== null && void act(() => stopCapture(capture.id))}
          >
            <Icon name="stop" /> {capture?.state === "finishing" ? "End refinement" : "Stop"}
          </button>
        </span>
      </form>
      {problem !== null && <Trouble text={problem} />}
    </Panel>
  );
}

function DeviceSign({ device }: { device: Device }): JSX.Element {
  return (
    <span title={device.reason}>
      <Badge tone={deviceTone[device.state]}>{device.state}</Badge>
    </span>
  );
}
