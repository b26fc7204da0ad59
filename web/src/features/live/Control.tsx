/** The form that starts and stops captures. */

import { type JSX, type SubmitEvent, useId, useState } from "react";

import { sourceKinds, startCapture, stopCapture } from "../../shared/api/calls";
import type { Capture, CaptureRequest, Device, SourceKind } from "../../shared/api/types";
import { useDenied } from "../../shared/state/access";
import { adjust } from "../../shared/state/route";
import { isAcquiring, isFinished, storeCapture, useService, errorText } from "../../shared/state/store";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton, ScopeNote } from "../../shared/ui/access";
import { Icon } from "../../shared/ui/icons";
import { fieldsOf, OptionInput, optionsOf, textOf, withOptions } from "../../shared/ui/options";
import { Badge, deviceTone, ErrorMessage, Labelled, Markup, Panel } from "../../shared/ui/parts";

type Length = "open" | "seconds" | "frames";
/** The length that is offered in each unit. */
const USUAL = { seconds: "0.1", frames: "2000" };
const OTHER = "(other)";

/** The request for a capture, from the values of the form. */
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
  const [other, setOther] = useState<string | null>(null);
  const [length, setLength] = useState<Length>("open");
  const [amount, setAmount] = useState(USUAL.seconds);
  const [name, setName] = useState("");
  const [record, setRecord] = useState(true);
  const [reconstruct, setReconstruct] = useState(true);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<string | null>(null);
  const kinds = useFetch("source kinds", sourceKinds).value ?? [];
  const ofFile = kinds.find((kind) => kind.can_block && kind.takes_path);
  const written = other ?? (ofFile === undefined ? "" : `${ofFile.name}:`);
  const ids = useId();
  const refining = capture?.state === "finishing";
  const [options, setOptions] = useState<Record<string, string>>({});
  const selected = chosen ?? devices[0]?.source ?? OTHER;
  const source = selected === OTHER ? written : selected;
  const kind = kinds.find((one) => isOfKind(source, one));
  const device = devices.find((one) => one.source === selected) ?? null;
  const denied = useDenied("operate");
  const text = withOptions(source, options);
  const inUse = useService((state) =>
    Object.values(state.captures).some(
      (one) => isAcquiring(one) && (one.id === device?.capture_id || one.source === text || one.source === source),
    ),
  );
  const fixed = inUse || denied !== null;

  const act = async (action: () => Promise<Capture>): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      storeCapture(await action());
    } catch (error) {
      setProblem(errorText(error));
    }
    setBusy(false);
  };
  const start = (event: SubmitEvent): void => {
    event.preventDefault();
    adjust({ capture: null, reconstruction: null, frame: null });
    void act(() => startCapture(planOf({ source: text, length, amount, name, record, reconstruct })));
  };

  return (
    <Panel title="Capture" aside={device !== null && <DeviceBadge device={device} />}>
      <form className="control" onSubmit={start}>
        <label htmlFor={`${ids}-source`}>Device</label>
        <select
          id={`${ids}-source`}
          value={selected}
          disabled={denied !== null}
          onChange={(event) => {
            setChosen(event.target.value);
            setOptions({});
            setProblem(null);
          }}
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
              value={written}
              disabled={fixed}
              spellCheck={false}
              autoComplete="off"
              placeholder={ofFile?.usage}
              aria-describedby={`${ids}-sources`}
              onChange={(event) => setOther(event.target.value)}
            />
            <p id={`${ids}-sources`} className="dim note">
              {kinds.map((kind, at) => (
                <span key={kind.name}>
                  {at > 0 && "; "}
                  <code>{kind.usage}</code> is {kind.summary}
                </span>
              ))}
            </p>
          </>
        )}
        {kind !== undefined && (
          <SourceOptions
            kind={kind}
            stated={optionsOf(source)}
            texts={options}
            disabled={fixed}
            onChange={(key, text) => setOptions((old) => ({ ...old, [key]: text }))}
          />
        )}
        <label htmlFor={`${ids}-name`}>Name</label>
        <input
          id={`${ids}-name`}
          value={name}
          disabled={fixed}
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
            disabled={fixed}
            onChange={(event) => {
              const unit = event.target.value as Length;
              setLength(unit);
              if (unit !== "open") setAmount(USUAL[unit]);
            }}
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
              disabled={fixed}
              required
              onChange={(event) => setAmount(event.target.value)}
            />
          )}
        </span>
        <span className="checks">
          <label
            className="check"
            title="Store the frames on disk, for downloads, further reconstructions and pictures of any frame"
          >
            <input
              type="checkbox"
              checked={record}
              disabled={fixed}
              onChange={(event) => setRecord(event.target.checked)}
            />
            Record
          </label>
          <label className="check" title="Track the camera and build the scene during the capture">
            <input
              type="checkbox"
              checked={reconstruct}
              disabled={fixed}
              onChange={(event) => setReconstruct(event.target.checked)}
            />
            Reconstruct
          </label>
        </span>
        <span className="buttons">
          <ActionButton
            type="submit"
            className="primary"
            disabled={inUse || busy}
            title={inUse ? "The device is in use: stop its capture first" : undefined}
          >
            <Icon name="start" /> Start
          </ActionButton>
          <ActionButton
            disabled={capture === null || isFinished(capture) || busy}
            onClick={() => capture !== null && void act(() => stopCapture(capture.id))}
          >
            <Icon name="stop" /> {refining ? "End refinement" : "Stop"}
          </ActionButton>
        </span>
      </form>
      <ScopeNote />
      {problem !== null && <ErrorMessage text={problem} />}
    </Panel>
  );
}

/** Whether the text names a source of the kind: its name, perhaps with a number, and a colon, or its options. */
const isOfKind = (source: string, kind: SourceKind): boolean => new RegExp(`^${kind.name}[0-9]*([:?]|$)`).test(source);

/** What can follow the question mark of a source, by the schema of its kind; closed at first. */
function SourceOptions({
  kind,
  stated,
  texts,
  disabled,
  onChange,
}: {
  kind: SourceKind;
  stated: Record<string, string>;
  texts: Record<string, string>;
  disabled: boolean;
  onChange: (key: string, text: string) => void;
}): JSX.Element {
  const fields = fieldsOf(kind.options);
  return (
    <details className="source-options">
      <summary>Camera and options of {kind.name}</summary>
      {fields.map((field) => (
        <Labelled key={field.key} label={field.label} hint={<Markup>{field.hint}</Markup>}>
          {(called) => (
            <OptionInput
              {...called}
              field={field}
              text={texts[field.key] ?? stated[field.key] ?? textOf(field.initial)}
              disabled={disabled}
              onChange={(text) => onChange(field.key, text)}
            />
          )}
        </Labelled>
      ))}
    </details>
  );
}

function DeviceBadge({ device }: { device: Device }): JSX.Element {
  return (
    <span title={device.reason}>
      <Badge tone={deviceTone[device.state]}>{device.state}</Badge>
    </span>
  );
}
