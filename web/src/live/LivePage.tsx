/** The camera as it runs: its picture, its frames, and what is made of them. */

import { type JSX, useEffect } from "react";

import { useRoute } from "../state/route";
import { loadReconstructions, newestCapture, newestReconstruction, useService } from "../state/store";
import { Loading, Panel } from "../ui/parts";
import { Control } from "./Control";
import { PictureView } from "./PictureView";
import { Progress } from "./Progress";
import { DevicePanel, Disk, Frames, VerdictCard } from "./Readings";

export function LivePage(): JSX.Element {
  const wanted = useRoute().capture;
  const capture = useService((state) =>
    wanted === null ? newestCapture(state.captures) : (state.captures[wanted] ?? null),
  );
  const job = useService((state) => newestReconstruction(state.reconstructions, capture?.id ?? null));
  const rateHz = useService((state) => state.rateHz);
  const loaded = useService((state) => state.loaded);
  const trouble = useService((state) => state.trouble);
  const devices = useService((state) => state.devices);
  const system = useService((state) => state.system);
  const id = capture?.id ?? null;
  useEffect(() => {
    if (id !== null) loadReconstructions(id).catch(() => undefined); // the band at the top tells
  }, [id]);
  if (!loaded && trouble === null) return <Loading what="the state of the service" />;
  const streaming = capture?.state === "streaming";
  const frameBytes = capture?.sensor == null ? null : (capture.sensor.width * capture.sensor.height) / 8;
  return (
    <div className="live">
      <h1 className="hidden">Live</h1>
      <PictureView capture={capture} />
      <div className="side">
        <Control capture={capture} />
        {capture !== null && <VerdictCard capture={capture} />}
        {capture !== null && <Frames capture={capture} rateHz={streaming ? rateHz : null} />}
        {capture !== null && <Progress job={job} />}
        <Panel title="Machine">
          {devices.map((device) => (
            <DevicePanel key={device.id} device={device} />
          ))}
          {devices.length === 0 && <p className="dim">No device is known.</p>}
          {system !== null && (
            <Disk
              system={system}
              bytesPerSecond={streaming && frameBytes !== null && rateHz !== null ? frameBytes * rateHz : null}
            />
          )}
        </Panel>
      </div>
    </div>
  );
}
