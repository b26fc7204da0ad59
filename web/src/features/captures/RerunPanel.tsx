/** The form for another reconstruction of a capture: options, given poses, calibration. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { OptionValues, Reconstruction } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { lensAsText, textAsLens, withLensText } from "../../shared/state/lensField";
import { useService } from "../../shared/state/store";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { OptionsForm } from "../../shared/ui/OptionsForm";
import { Labelled, Panel } from "../../shared/ui/parts";
import { thinned } from "./thinned";

const FILE = "file";

export function RerunPanel({
  initial,
  jobs,
  nameOf,
  onSubmit,
  onCancel,
}: {
  initial: OptionValues;
  /** Reconstructions of the capture, whose paths can be taken. */
  jobs: readonly Reconstruction[];
  nameOf: (job: Reconstruction) => string;
  onSubmit: (values: OptionValues, given: calls.Given) => Promise<void>;
  onCancel: () => void;
}): JSX.Element {
  const schema = useFetch("options", calls.optionSchema);
  const devices = useService((state) => state.devices);
  const [from, setFrom] = useState("");
  const [poses, setPoses] = useState<Promise<ReturnType<typeof thinned>> | null>(null);
  const [thinning, setThinning] = useState("");
  const [calibration, setCalibration] = useState("");
  const paths = jobs.filter((one) => one.version > 0 && one.poses > 1);

  const choose = async (file: File | undefined): Promise<void> => {
    const read = file === undefined ? null : file.text().then((text) => thinned(text));
    setPoses(read);
    setThinning("");
    await attempt(async () => {
      const every = (await read)?.every ?? 1;
      if (file !== undefined && every > 1) setThinning(` Every ${every}th pose of ${file.name} is sent.`);
    });
  };
  const submit = async (values: OptionValues): Promise<void> => {
    await attempt(async () => {
      if (from === FILE && poses === null) throw new Error("Choose the TUM file with the poses.");
      await onSubmit(textAsLens(values), {
        poses: from === FILE && poses !== null ? (await poses).text : null,
        poses_of: from === FILE || from === "" ? null : from,
        calibration_of: calibration === "" ? null : calibration,
      });
    });
  };
  return (
    <Panel title="Options of the new reconstruction">
      <Fetched from={schema} what="the options">
        {(fields) => (
          <OptionsForm
            schema={withLensText(fields)}
            initial={lensAsText(initial)}
            action="Reconstruct"
            onSubmit={submit}
            onCancel={onCancel}
          >
            <Labelled
              label="poses"
              hint="Given poses are not changed: the map is fitted to them. Those in between are interpolated."
            >
              {(called) => (
                <select {...called} value={from} onChange={(event) => setFrom(event.target.value)}>
                  <option value="">estimate them</option>
                  <option value={FILE}>from a TUM file…</option>
                  {paths.map((one) => (
                    <option key={one.id} value={one.id}>
                      of reconstruction {nameOf(one)} {one.name}
                    </option>
                  ))}
                </select>
              )}
            </Labelled>
            {from === FILE && (
              <Labelled
                label="file with poses"
                hint={
                  <>
                    Lines <code>time x y z qx qy qz qw</code>, camera to world, in seconds since the start of the
                    capture.
                    {thinning}
                  </>
                }
              >
                {(called) => (
                  <input
                    {...called}
                    type="file"
                    accept=".tum,.txt"
                    onChange={(event) => void choose(event.target.files?.[0])}
                  />
                )}
              </Labelled>
            )}
            <Labelled label="calibration" hint="Gains, dark rates and dead pixels, by which the rates are corrected.">
              {(called) => (
                <select {...called} value={calibration} onChange={(event) => setCalibration(event.target.value)}>
                  <option value="">that of the recording, if any</option>
                  {devices.map((one) => (
                    <option key={one.id} value={one.id}>
                      of {one.id}, as it is now
                    </option>
                  ))}
                </select>
              )}
            </Labelled>
          </OptionsForm>
        )}
      </Fetched>
    </Panel>
  );
}
