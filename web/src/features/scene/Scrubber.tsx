/** Time slider over the whole capture: drag, play, or follow the newest pose. */

import { type JSX, useEffect, useRef, useState } from "react";

import { timeline as askTimeline } from "../../shared/api/calls";
import { count, duration } from "../../shared/state/format";
import { adjust, route } from "../../shared/state/route";
import { useFetch } from "../../shared/state/useFetch";
import { useDark } from "../../shared/state/theme";
import { Icon } from "../../shared/ui/icons";
import { trackingMeaning } from "../../shared/ui/parts";
import { type Path, rowAt, stateAt } from "./path";
import { type Missing, paint } from "./timelineStrip";

/** Duration of playback of a whole capture, in seconds. */
const PLAYED_S = 10;

export function Scrubber({
  path,
  row,
  frameRateHz,
  live,
  jobId,
  version,
}: {
  path: Path | null;
  row: number;
  frameRateHz: number | null;
  live: boolean;
  jobId: string;
  version: number;
}): JSX.Element {
  const [playing, setPlaying] = useState(false);
  const strip = useRef<HTMLCanvasElement>(null);
  const first = path?.frames[0] ?? 0;
  const last = path?.frames.at(-1) ?? 0;
  const frame = path?.frames[row] ?? 0;
  const following = route().frame === null;
  const dark = useDark();
  const timeline = useFetch(version === 0 ? null : `${jobId} ${version}`, () => askTimeline(jobId));
  const gaps = timeline.value?.gaps;
  const state = path === null || row < 0 ? null : stateAt(path, row);

  useEffect(() => {
    if (!playing || last <= first) return;
    let handle = 0;
    let before = performance.now();
    let now = route().frame ?? first;
    if (now >= last) now = first;
    const step = (at: number): void => {
      now += ((at - before) / 1000) * ((last - first) / PLAYED_S);
      before = at;
      adjust({ frame: Math.min(Math.round(now), last) });
      if (now >= last) setPlaying(false);
      else handle = requestAnimationFrame(step);
    };
    handle = requestAnimationFrame(step);
    return () => cancelAnimationFrame(handle);
  }, [playing, first, last]);

  useEffect(() => {
    const canvas = strip.current;
    if (canvas !== null && path !== null) paint(canvas, path, gaps ?? []);
  }, [path, gaps, dark]);

  const time = frameRateHz === null ? null : frame / frameRateHz;
  const slowed = frameRateHz === null || last <= first ? null : (PLAYED_S * frameRateHz) / (last - first);
  return (
    <div className="scrubber" role="group" aria-label="Time">
      <button
        type="button"
        aria-label={playing ? "Pause" : "Play"}
        title={slowed === null ? "Play" : `Play, slowed ${slowed.toFixed(0)} times`}
        disabled={last <= first}
        onClick={() => setPlaying(!playing)}
      >
        <Icon name={playing ? "pause" : "start"} />
      </button>
      <div
        className="track"
        onPointerMove={(event) => {
          const box = event.currentTarget.getBoundingClientRect();
          const at = first + ((event.clientX - box.left) / Math.max(box.width, 1)) * (last - first);
          if (path !== null) event.currentTarget.title = describe(path, gaps ?? [], at);
        }}
      >
        <canvas ref={strip} aria-hidden="true" />
        <input
          type="range"
          aria-label="Frame"
          aria-valuetext={[`frame ${frame}`, time === null ? null : duration(time), state].filter(Boolean).join(", ")}
          min={first}
          max={Math.max(last, first + 1)}
          step={1}
          value={frame}
          disabled={last <= first}
          onChange={(event) => {
            setPlaying(false);
            adjust({ frame: event.target.valueAsNumber });
          }}
        />
      </div>
      <output>
        {time === null ? "–" : duration(time)}{" "}
        <span className="dim">
          frame {count(frame)}
          {state !== null && ` · ${state}`}
        </span>
      </output>
      <button
        type="button"
        aria-pressed={following}
        onClick={() => {
          setPlaying(false);
          adjust({ frame: null });
        }}
      >
        <Icon name="edge" /> {live ? "Live" : "End"}
      </button>
    </div>
  );
}

/** Text for the timeline at a frame. */
function describe(path: Path, gaps: readonly Missing[], frame: number): string {
  const gap = gaps.find((one) => frame >= one.first && frame < one.first + one.count);
  if (gap !== undefined) return `${count(gap.count)} frames are missing, lost by: ${gap.cause}`;
  const row = rowAt(path, frame);
  if (row < 0) return "";
  const state = stateAt(path, row);
  return `${state}: ${trackingMeaning[state]}`;
}
