/** Camera profiles: what is known of each device, to be edited, and its calibration. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Device, OptionSchema, OptionValues, Profile } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { lensAsText, textAsLens, withLensText } from "../../shared/state/lensField";
import { useService } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton, ScopeNote } from "../../shared/ui/access";
import { Fetched } from "../../shared/ui/Fetched";
import { OptionsForm } from "../../shared/ui/OptionsForm";
import { Empty, Panel } from "../../shared/ui/parts";
import { CalibrationPanel } from "./CalibrationPanel";

export function ProfilePanel(): JSX.Element {
  const devices = useService((state) => state.devices);
  const [chosen, setChosen] = useState<string | null>(null);
  const device = devices.find((one) => one.id === chosen) ?? devices[0];
  return (
    <Panel title="Cameras">
      {device === undefined ? (
        <Empty icon="camera" title="No cameras" />
      ) : (
        <>
          <label className="choice">
            <span>Camera</span>
            <select value={device.id} onChange={(event) => setChosen(event.target.value)}>
              {devices.map((one) => (
                <option key={one.id} value={one.id}>
                  {one.id} · {one.serial ?? one.description}
                </option>
              ))}
            </select>
          </label>
          <OfDevice key={device.id} device={device} />
          <ScopeNote />
        </>
      )}
    </Panel>
  );
}

function OfDevice({ device }: { device: Device }): JSX.Element {
  const schema = useFetch("profile options", calls.profileSchema);
  const profile = useFetch(`profile of ${device.id}`, () => calls.profile(device.id));
  return (
    <Fetched from={schema} what="the fields of a profile">
      {(fields) => (
        <Fetched from={profile} what="the profile">
          {(found) => (
            <>
              <p>
                {found.profile === null
                  ? "Nothing is stated of this camera."
                  : "Captures of this camera take what is stated here."}{" "}
                <span className="dim">Options of a source or a request win over it.</span>
              </p>
              <details>
                <summary>Profile</summary>
                <ProfileForm
                  key={JSON.stringify(found.profile)}
                  device={device}
                  schema={fields}
                  profile={found.profile}
                  onChange={profile.again}
                />
              </details>
              <CalibrationPanel device={device} file={found.profile?.calibration ?? null} onChange={profile.again} />
            </>
          )}
        </Fetched>
      )}
    </Fetched>
  );
}

function ProfileForm({
  device,
  schema,
  profile,
  onChange,
}: {
  device: Device;
  schema: OptionSchema;
  profile: Profile | null;
  onChange: () => void;
}): JSX.Element {
  const save = async (values: OptionValues): Promise<void> => {
    if (await attempt(() => calls.setProfile(device.id, textAsLens(values)))) {
      toast("Profile saved; captures that run keep theirs");
      onChange();
    }
  };
  const remove = async (): Promise<void> => {
    if (!(await attempt(() => calls.removeProfile(device.id)))) return;
    toast("Profile removed");
    onChange();
  };
  return (
    <>
      <OptionsForm schema={withLensText(schema)} initial={lensAsText({ ...profile })} action="Save" onSubmit={save} />
      {profile !== null && <ActionButton onClick={() => void remove()}>Remove the profile</ActionButton>}
    </>
  );
}
