/** Time over the whole capture: drag, play, or follow the newest. */

import { type JSX, useEffect, useRef, useState } from "react";

import { timeline as askTimeline } from "../api/calls";
import { count, duration } from "../state/format";
import { adjust, route } from "../state/route";
import { useAsked } from "../state/useAsked";
import { colour, useDark } from "../state/theme";
import { Icon } from "../ui/icons";
import { type Path, STATE_COLOURS } from "./path";

/** A capture is played in so many seconds, however short it was. */
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
  const told = useAsked(version === 0 ? null : `${jobId} ${version}`, () => askTimeline(jobId));
  const gaps = told.value?.gaps;

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
    if (canvas !== null && path !== null) paint(canvas, path, first, last, gaps ?? []);
  }, [path, first, last, gaps, dark]);

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
      <div className="track">
        <canvas ref={strip} aria-hidden="true" />
        <input
          type="range"
          aria-label="Frame"
          aria-valuetext={`frame ${frame}${time === null ? "" : `, ${duration(time)}`}`}
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
        {time === null ? "–" : duration(time)} <span className="dim">frame {count(frame)}</span>
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

/** How the tracking went: a band in the colours of the states, cut where frames are missing. */
function paint(
  canvas: HTMLCanvasElement,
  path: Path,
  first: number,
  last: number,
  gaps: readonly { first: number; count: number }[],
): void {
  const ratio = window.devicePixelRatio;
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  canvas.width = width;
  canvas.height = height;
  const pen = canvas.getContext("2d");
  if (pen === null || last <= first) return;
  const place = (frame: number): number => ((frame - first) / (last - first)) * width;
  const n = path.frames.length;
  for (let i = 0; i < n;) {
    const state = path.states[i] ?? "track";
    let end = i + 1;
    while (end < n && (path.states[end] ?? "track") === state) end += 1;
    const from = place(path.frames[i] ?? 0);
    const to = place(path.frames[Math.min(end, n - 1)] ?? 0);
    pen.fillStyle = STATE_COLOURS[state];
    pen.fillRect(from, 0, Math.max(to - from, 1), height);
    i = end;
  }
  pen.fillStyle = colour("paper");
  for (const gap of gaps)
    pen.fillRect(place(gap.first), 0, Math.max((gap.count / (last - first)) * width, ratio), height);
}
