/** The form that uploads a recording: dropped or picked, described, sent, and opened as a capture. */

import { type JSX, useEffect, useRef, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { OptionValues } from "../../shared/api/types";
import { bytes } from "../../shared/state/format";
import { go } from "../../shared/state/route";
import { errorText, useService } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { ScopeNote } from "../../shared/ui/access";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { OptionsForm } from "../../shared/ui/OptionsForm";
import { ErrorMessage, Panel } from "../../shared/ui/parts";
import { sizeText, statedOf, uploadFields, valuesOfSidecar } from "./uploadForm";
import { upload } from "./uploads";

interface Chosen {
  file: File;
  sidecar: Record<string, unknown> | null;
  calibration: File | null;
}

export function UploadPanel({ onClose }: { onClose: () => void }): JSX.Element {
  const schema = useFetch("upload options", calls.uploadSchema);
  const [chosen, setChosen] = useState<Chosen | null>(null);
  const [problem, setProblem] = useState<string | null>(null);
  const choose = (files: readonly File[]): void => {
    chosenOf(files).then(
      (found) => {
        setChosen(found);
        setProblem(null);
      },
      (error: unknown) => setProblem(errorText(error)),
    );
  };
  const close = (
    <button type="button" onClick={onClose}>
      Close
    </button>
  );
  return (
    <Panel title="Upload a recording" className="upload" aside={close}>
      <DropZone chosen={chosen} onChoose={choose} />
      {problem !== null && <ErrorMessage text={problem} />}
      {chosen !== null && (
        <Fetched from={schema} what="what an upload can state">
          {(found) => <UploadForm key={nameOfChosen(chosen)} chosen={chosen} fields={uploadFields(found)} />}
        </Fetched>
      )}
      <ScopeNote />
    </Panel>
  );
}

function DropZone({
  chosen,
  onChoose,
}: {
  chosen: Chosen | null;
  onChoose: (files: readonly File[]) => void;
}): JSX.Element {
  const [over, setOver] = useState(false);
  // The input covers the zone: files may be dropped on it without more.
  return (
    <label className={over ? "drop over" : "drop"}>
      <input
        type="file"
        multiple
        aria-label="Files to upload"
        onDragEnter={() => setOver(true)}
        onDragLeave={() => setOver(false)}
        onDrop={() => setOver(false)}
        onChange={(event) => onChoose([...(event.target.files ?? [])])}
      />
      <Icon name="upload" />
      {chosen === null ? (
        <span>
          Drop a recording here, or <u>choose files</u>
        </span>
      ) : (
        <span>
          <strong>{chosen.file.name}</strong>, {bytes(chosen.file.size)}
          {chosen.sidecar !== null && ", with its sidecar"}
          {chosen.calibration !== null && `, with the calibration ${chosen.calibration.name}`}
        </span>
      )}
      <small className="dim">
        A <code>.dat</code> with its <code>.json</code> beside it, arrays of NumPy or HDF5, or raw bytes of a camera; a
        calibration <code>calibration.npz</code> may come along.
      </small>
    </label>
  );
}

function UploadForm({ chosen, fields }: { chosen: Chosen; fields: ReturnType<typeof uploadFields> }): JSX.Element {
  const devices = useService((state) => state.devices);
  const [name, setName] = useState(chosen.file.name);
  const [device, setDevice] = useState("");
  const [problem, setProblem] = useState<string | null>(null);
  const [values, setValues] = useState<OptionValues>(() => valuesOfSidecar(chosen.sidecar ?? {}));
  const here = useRef(false);
  useEffect(() => {
    here.current = true;
    return () => {
      here.current = false;
    };
  }, []);
  const size = sizeText(chosen.file.name, chosen.file.size, values);

  const send = async (stated: OptionValues): Promise<void> => {
    setProblem(null);
    try {
      const request = {
        name,
        notes: "",
        bytes: chosen.file.size,
        sidecar: chosen.sidecar as never,
        device: device === "" ? null : device,
        ...statedOf(stated),
      };
      const capture = await upload(chosen.file, request, chosen.calibration);
      if (capture === null) return;
      const open = (): void => go({ page: "captures", capture: capture.id });
      if (here.current) open();
      else toast(`Uploaded ${name}`, { action: { label: "Open", run: open } });
    } catch (error) {
      if (here.current) setProblem(errorText(error));
      else toast(`${name} was not uploaded. ${errorText(error)}`, { tone: "problem" });
    }
  };

  return (
    <>
      <div className="row">
        <label>
          <span>Name</span>
          <input required maxLength={200} value={name} onChange={(event) => setName(event.target.value)} />
        </label>
        <label>
          <span>Camera</span>
          <select value={device} onChange={(event) => setDevice(event.target.value)}>
            <option value="">as stated below</option>
            {devices.map((one) => (
              <option key={one.id} value={one.id}>
                profile of {one.id}
              </option>
            ))}
          </select>
        </label>
      </div>
      <p className={size === null ? "dim" : size.fits ? "good" : "warning"} role="status">
        {size === null
          ? "What the file or its sidecar says need not be stated. A file without either needs width, height and rate."
          : size.text}
      </p>
      <OptionsForm schema={fields} initial={values} action="Upload" onSubmit={send} onChange={setValues} />
      {problem !== null && <ErrorMessage text={problem} />}
    </>
  );
}

const nameOfChosen = (chosen: Chosen): string => `${chosen.file.name} ${chosen.file.lastModified} ${chosen.file.size}`;

/** The recording among some files, with the sidecar and the calibration beside it. Throws an Error. */
async function chosenOf(files: readonly File[]): Promise<Chosen> {
  const sidecar = files.find((file) => file.name.endsWith(".json"));
  const calibration = files.length > 1 ? files.find((file) => /calibration.*\.npz$/.test(file.name)) : undefined;
  const others = files.filter((file) => file !== sidecar && file !== calibration);
  const [file] = others;
  if (file === undefined) throw new Error("A sidecar alone is no recording: choose the file of frames, too.");
  if (others.length > 1) throw new Error("These are several recordings: choose one, with its .json if there is one.");
  if (file.size === 0) throw new Error(`${file.name} is empty.`);
  return { file, sidecar: sidecar === undefined ? null : await read(sidecar), calibration: calibration ?? null };
}

async function read(sidecar: File): Promise<Record<string, unknown>> {
  try {
    const found: unknown = JSON.parse(await sidecar.text());
    if (typeof found === "object" && found !== null && !Array.isArray(found)) return found as Record<string, unknown>;
  } catch {
    // told below
  }
  throw new Error(`${sidecar.name} is no sidecar: it has to be a JSON object.`);
}
