/** The Live page: picture, frame counters, control and reconstruction progress. */

import type { JSX } from "react";

import { go, useRoute } from "../../shared/state/route";
import { nameOf } from "../../shared/state/capture";
import { acquiringCaptures, newestCapture, newestReconstruction, useService } from "../../shared/state/store";
import { useWanted } from "../../shared/state/useWanted";
import { PageLink } from "../../shared/ui/PageLink";
import { CaptureBadge, ErrorMessage, Loading, Panel } from "../../shared/ui/parts";
import { Control } from "./Control";
import { PictureView } from "./PictureView";
import { Progress } from "./Progress";
import { Queue } from "./Queue";
import { DevicePanel, Disk, FrameStats, VerdictCard } from "./FrameStats";

/** Which one is shown, where several cameras capture at the same time. */
function Running({ shown }: { shown: string | null }): JSX.Element | null {
  const captures = useService((state) => state.captures);
  const running = acquiringCaptures(captures);
  if (running.length === 0 || (running.length === 1 && running[0]?.id === shown)) return null;
  return (
    <Panel title="Captures that run">
      <ul className="running">
        {running.map((one) => (
          <li key={one.id}>
            <PageLink
              to={{ page: "live", capture: one.id, reconstruction: null }}
              aria-current={one.id === shown ? "true" : undefined}
            >
              {nameOf(one)}
            </PageLink>
            <span className="dim">{one.source}</span>
            <CaptureBadge capture={one} />
          </li>
        ))}
      </ul>
    </Panel>
  );
}

export function LivePage(): JSX.Element {
  const wanted = useRoute().capture;
  const capture = useService((state) =>
    wanted === null ? newestCapture(state.captures) : (state.captures[wanted] ?? null),
  );
  const job = useService((state) => newestReconstruction(state.reconstructions, capture?.id ?? null));
  const rateHz = useService((state) => (capture === null ? null : (state.rates[capture.id] ?? null)));
  const loaded = useService((state) => state.loaded);
  const connectionError = useService((state) => state.connectionError);
  const devices = useService((state) => state.devices);
  const system = useService((state) => state.system);
  const id = capture?.id ?? null;
  const problem = useWanted(wanted, capture);
  if (!loaded && connectionError === null) return <Loading what="the state of the service" />;
  if (problem !== null)
    return (
      <ErrorMessage text={problem} again={() => go({ capture: null, reconstruction: null })} called="Newest capture" />
    );
  const streaming = capture?.state === "streaming";
  return (
    <div className="live">
      <h1 className="hidden">Live</h1>
      <PictureView capture={capture} />
      <div className="side">
        <Running shown={id} />
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
