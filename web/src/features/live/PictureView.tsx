/** The live picture, with hot pixels marked. */

import { type JSX, useEffect, useRef, useState } from "react";

import { stats } from "../../shared/api/calls";
import type { Capture, PreviewKind, Stats } from "../../shared/api/types";
import { count } from "../../shared/state/format";
import { isFinished } from "../../shared/state/store";
import { Icon } from "../../shared/ui/icons";
import { Empty, Loading, Segmented } from "../../shared/ui/parts";
import { SETTLED_MS } from "./asking";
import { Histogram } from "./Histogram";
import { RegionOverlay, RegionPanel } from "./RegionTool";
import { type Region, same, within } from "./region";
import { usePicture } from "./usePicture";

const KINDS: readonly { value: PreviewKind; label: string; hint: string }[] = [
  { value: "interval", label: "Interval", hint: "Brightness from the time between spikes: follows motion" },
  {
    value: "accumulation",
    label: "Accumulation",
    hint: "Spikes counted over a longer window: less noise, blurred by motion",
  },
  { value: "render", label: "Render", hint: "The reconstructed scene, seen from the newest tracked pose" },
];
const STATS_MS = 1000;

function useStats(capture: Capture | null, region: Region | null, moment: number | null): Stats | null {
  const [value, setValue] = useState<{ key: string; stats: Stats } | null>(null);
  const id = capture?.id ?? null;
  const key = `${id ?? ""} ${JSON.stringify(region)}`;
  const over = capture === null || isFinished(capture);
  const begun = over || (capture.counters?.received ?? 0) > 0;
  useEffect(() => {
    if (id === null || !begun) return;
    let current = true;
    const ask = (): void => {
      stats(id, region, moment).then(
        (got) => current && setValue({ key, stats: got }),
        () => undefined, // the picture says that there is nothing yet
      );
    };
    const first = setTimeout(ask, moment === null ? 0 : SETTLED_MS);
    const timer = over ? undefined : setInterval(ask, STATS_MS);
    return () => {
      current = false;
      clearTimeout(first);
      clearInterval(timer);
    };
  }, [id, over, begun, key, region, moment]);
  return value?.key === key ? value.stats : null;
}

export function PictureView({ capture }: { capture: Capture | null }): JSX.Element {
  const [kind, setKind] = useState<PreviewKind>("interval");
  const [stops, setStops] = useState(0);
  const [marked, setMarked] = useState(true);
  const gain = 2 ** stops;
  const [chosenMoment, setMoment] = useState<{ id: string; frame: number } | null>(null);
  const moment = chosenMoment !== null && chosenMoment.id === capture?.id ? chosenMoment.frame : null;
  const picture = usePicture(capture, kind, gain, moment);
  const sensor = capture?.sensor ?? null;
  const [chosen, setChosen] = useState<Region | null>(null);
  const fits = chosen === null || sensor === null ? chosen : within(chosen, sensor);
  const region = fits !== null && chosen !== null && same(fits, chosen) ? chosen : null; // of a larger camera before
  const measured = useStats(capture, region, moment);
  const histogram = measured?.rate_histogram ?? null;
  const image = useRef<HTMLImageElement>(null);
  useEffect(() => {
    if (image.current !== null)
      image.current.style.filter = picture?.gained === true || gain === 1 ? "" : `brightness(${gain})`;
  }, [gain, picture?.gained]);
  const hot = measured?.hot_pixels ?? [];
  return (
    <section className="panel picture" aria-label="Live picture">
      <header className="tools">
        <Segmented label="Picture" value={kind} choices={KINDS} onChange={setKind} />
        <label className="slider">
          Gain
          <input
            type="range"
            min={-3}
            max={5}
            step={0.25}
            value={stops}
            aria-valuetext={`${gain.toFixed(2)} times`}
            onChange={(event) => setStops(event.target.valueAsNumber)}
            onDoubleClick={() => setStops(0)}
          />
          <output>×{gain < 10 ? gain.toFixed(2) : gain.toFixed(0)}</output>
        </label>
        <label className="check">
          <input type="checkbox" checked={marked} onChange={(event) => setMarked(event.target.checked)} />
          Hot pixels <output>{measured === null ? "–" : count(hot.length)}</output>
        </label>
      </header>
      <div className="frame">
        {picture === undefined && capture !== null && isFinished(capture) && capture.state !== "failed" ? (
          <Loading what="the picture" />
        ) : picture == null ? (
          <NoPicture capture={capture} kind={kind} moment={moment} />
        ) : (
          <div className="stack">
            <img
              ref={image}
              src={picture.url}
              alt={moment === null ? `Newest frames, ${kind}` : `Frame ${moment}, ${kind}`}
            />
            {marked && sensor !== null && hot.length > 0 && (
              <svg
                className="marks"
                viewBox={`0 0 ${sensor.width} ${sensor.height}`}
                aria-label={`${hot.length} hot pixels`}
                role="img"
              >
                {hot.slice(0, 2000).map(([x = 0, y = 0]) => (
                  <circle key={`${x} ${y}`} cx={x + 0.5} cy={y + 0.5} r={sensor.width / 110} />
                ))}
              </svg>
            )}
            {sensor !== null && <RegionOverlay sensor={sensor} region={region} onRegion={setChosen} />}
            <Caption capture={capture} frame={picture.frame} />
          </div>
        )}
      </div>
      {capture !== null && (
        <Moment
          capture={capture}
          frame={moment ?? picture?.frame ?? null}
          onFrame={(frame) => setMoment({ id: capture.id, frame })}
        />
      )}
      {capture !== null && sensor !== null && picture != null && (
        <RegionPanel
          capture={capture.id}
          sensor={sensor}
          region={region}
          stats={measured}
          over={isFinished(capture)}
          frame={moment ?? picture.frame}
          onRegion={setChosen}
        />
      )}
      <Histogram
        histogram={histogram}
        meanRate={measured?.mean_rate ?? null}
        frameRateHz={sensor?.frame_rate_hz ?? null}
      />
    </section>
  );
}

/** Which frame of a recording is shown. */
function Moment({
  capture,
  frame,
  onFrame,
}: {
  capture: Capture;
  frame: number | null;
  onFrame: (frame: number) => void;
}): JSX.Element | null {
  const { recording, sensor } = capture;
  if (recording === null || sensor === null || !isFinished(capture)) return null;
  const first = recording.first_frame;
  const last = first + recording.frames + recording.lost - 1;
  const at = frame ?? Math.round((first + last) / 2);
  const ms = ((1000 * at) / sensor.frame_rate_hz).toFixed(1);
  return (
    <label className="slider moment">
      Moment
      <input
        type="range"
        min={first}
        max={last}
        value={at}
        aria-valuetext={`frame ${at}, ${ms} ms`}
        onChange={(event) => onFrame(event.target.valueAsNumber)}
      />
      <output>{ms} ms</output>
    </label>
  );
}

function Caption({ capture, frame }: { capture: Capture | null; frame: number | null }): JSX.Element {
  const sensor = capture?.sensor;
  return (
    <p className="caption">
      {sensor != null && `${sensor.width} × ${sensor.height}`}
      {frame !== null && ` · frame ${count(frame)}`}
      {frame !== null && sensor != null && ` · ${((1000 * frame) / sensor.frame_rate_hz).toFixed(1)} ms`}
    </p>
  );
}

function NoPicture({
  capture,
  kind,
  moment,
}: {
  capture: Capture | null;
  kind: PreviewKind;
  moment: number | null;
}): JSX.Element {
  if (capture === null)
    return (
      <Empty icon="camera" title="No capture yet">
        Choose a device and press <b>Start</b>. Without a camera, <b>sim:</b> is a simulated one and <b>replay:</b>{" "}
        plays a recording.
      </Empty>
    );
  if (capture.state === "failed")
    return (
      <Empty icon="problem" title="The capture has failed">
        {capture.reason}
      </Empty>
    );
  if (moment !== null)
    return (
      <Empty icon="camera" title="No picture of this moment">
        {kind === "render" ? "The scene has no pose at this frame." : "This frame was lost."}
      </Empty>
    );
  if (kind === "render")
    return (
      <Empty icon="scene" title="Nothing rendered yet">
        The scene appears here as soon as the first poses are tracked.
      </Empty>
    );
  if (isFinished(capture))
    return (
      <Empty icon="camera" title="No picture of this capture">
        It was not recorded, and live pictures are not stored.
      </Empty>
    );
  return (
    <div className="empty" role="status">
      <Icon name="camera" />
      <strong>Waiting for the first frames…</strong>
      {capture.reason !== "" && <p>{capture.reason}</p>}
    </div>
  );
}
