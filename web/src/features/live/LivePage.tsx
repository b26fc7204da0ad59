/** The Live page: picture, frame counters, control and reconstruction progress. */

import { type JSX, useEffect } from "react";

import { useRoute } from "../../shared/state/route";
import { loadReconstructions, newestCapture, newestReconstruction, useService } from "../../shared/state/store";
import { Loading, Panel } from "../../shared/ui/parts";
import { Control } from "./Control";
import { PictureView } from "./PictureView";
import { Progress } from "./Progress";
import { Queue } from "./Queue";
import { DevicePanel, Disk, FrameStats, VerdictCard } from "./FrameStats";

export function LivePage(): JSX.Element {
  const wanted = useRoute().capture;
  const capture = useService((state) =>
    wanted === null ? newestCapture(state.captures) : (state.captures[wanted] ?? null),
  );
  const job = useService((state) => newestReconstruction(state.reconstructions, capture?.id ?? null));
  const rateHz = useService((state) => state.rateHz);
  const loaded = useService((state) => state.loaded);
  const connectionError = useService((state) => state.connectionError);
  const devices = useService((state) => state.devices);
  const system = useService((state) => state.system);
  const id = capture?.id ?? null;
  useEffect(() => {
    if (id !== null) loadReconstructions(id).catch(() => undefined); // shown by the banner at the top
  }, [id]);
  if (!loaded && connectionError === null) return <Loading what="the state of the service" />;
  const streaming = capture?.state === "streaming";
  return (
    <div className="live">
      <h1 className="hidden">Live</h1>
      <PictureView capture={capture} />
      <div className="side">
        <Control capture={capture} />
        {capture !== null && <VerdictCard capture={capture} />}
        {capture !== null && <FrameStats capture={capture} rateHz={streaming ? rateHz : null} />}
        {capture !== null && <Progress job={job} />}
        <Queue shown={id} />
        <Panel title="Machine">
          {devices.map((device) => (
            <DevicePanel key={device.id} device={device} />
          ))}
          {devices.length === 0 && <p className="dim">No devices.</p>}
          {system !== null && <Disk system={system} />}
        </Panel>
      </div>
    </div>
  );
}
