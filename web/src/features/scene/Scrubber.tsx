/** Time slider over the capture or a part of it: drag, play, follow the newest pose, zoom into the timeline. */

import { type JSX, type KeyboardEvent, useEffect, useRef, useState } from "react";

import type { Timeline } from "../../shared/api/types";
import { count, duration } from "../../shared/state/format";
import { adjust, route } from "../../shared/state/route";
import { useDark } from "../../shared/state/theme";
import { Icon } from "../../shared/ui/icons";
import { trackingMeaning } from "../../shared/ui/parts";
import { type Path, rowAt, stateAt } from "./path";
import { type Missing, paint } from "./timelineStrip";
import { containing, moved, type Span, ZOOM_STEP, zoomed } from "./timelineWindow";
import { useGestures } from "./useGestures";
import { useTimeline } from "./useTimeline";

/** Duration of playback of all that the timeline shows, in seconds. */
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
  const [zoom, setZoom] = useState<Span | null>(null);
  const whole: Span = { first: path?.frames[0] ?? 0, last: path?.frames.at(-1) ?? 0 };
  const frame = path?.frames[row] ?? 0;
  const following = route().frame === null;
  // Where the newest pose is followed, it does not leave the part that is shown.
  const part = following ? containing(zoom, whole, frame) : zoom;
  const shown = part ?? whole;
  const { first, last } = shown;
  const timeline = useTimeline(jobId, version, part, frameRateHz);
  const state = path === null || row < 0 ? null : stateAt(path, row);
  const empty = whole.last <= whole.first;

  useEffect(() => {
    if (!playing || last <= first) return;
    let handle = 0;
    let before = performance.now();
    let now = route().frame ?? first;
    if (now >= last || now < first) now = first;
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

  const seek = (to: number): void => {
    setPlaying(false);
    adjust({ frame: Math.round(Math.min(Math.max(to, whole.first), whole.last)) });
  };
  /** Several gestures may come before the next rendering. Who looks elsewhere follows the newest pose no longer. */
  const look = (change: (before: Span | null) => Span | null): void => {
    const next = change(part);
    if (following && next !== null && (frame < next.first || frame > next.last)) adjust({ frame });
    setZoom((before) => change(following ? containing(before, whole, frame) : before));
  };
  const zoomBy = (factor: number, around = frame): void => look((before) => zoomed(before, whole, factor, around));
  const pan = (frames: number): void => look((before) => moved(before, whole, frames));
  const onKeyDown = (event: KeyboardEvent): void => {
    const action = {
      "+": () => zoomBy(ZOOM_STEP),
      "=": () => zoomBy(ZOOM_STEP),
      "-": () => zoomBy(1 / ZOOM_STEP),
      "0": () => setZoom(null),
    }[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  };
  const time = (at: number): string => (frameRateHz === null ? `frame ${count(at)}` : duration(at / frameRateHz));
  const slowed = frameRateHz === null || last <= first ? null : (PLAYED_S * frameRateHz) / (last - first);
  return (
    // The keys work wherever the focus is among these controls.
    // eslint-disable-next-line jsx-a11y/no-noninteractive-element-interactions
    <div className="scrubber" role="group" aria-label="Time" onKeyDown={onKeyDown}>
      <button
        type="button"
        aria-label={playing ? "Pause" : "Play"}
        title={slowed === null ? "Play" : `Play, slowed ${slowed.toFixed(0)} times`}
        disabled={empty}
        onClick={() => setPlaying(!playing)}
      >
        <Icon name={playing ? "pause" : "start"} />
      </button>
      <div className="track">
        <Strip
          timelines={[timeline.whole, timeline.part].filter((one) => one !== null)}
          shown={shown}
          frameRateHz={frameRateHz}
          describe={(at) => (path === null ? "" : describe(path, (timeline.part ?? timeline.whole)?.gaps ?? [], at))}
          onZoom={zoomBy}
          onPan={pan}
          onSeek={seek}
        />
        <input
          type="range"
          aria-label="Frame"
          aria-valuetext={[`frame ${frame}`, frameRateHz !== null && time(frame), state].filter(Boolean).join(", ")}
          min={first}
          max={Math.max(last, first + 1)}
          step={1}
          value={Math.min(Math.max(frame, first), last)}
          disabled={empty}
          onChange={(event) => seek(event.target.valueAsNumber)}
        />
        <div className="overview" aria-hidden="true">
          {/* The room is kept, so that nothing moves from under the pointer. */}
          {part !== null && (
            <Overview timeline={timeline.whole} whole={whole} part={part} frameRateHz={frameRateHz} onMove={pan} />
          )}
        </div>
      </div>
      <div className="zoom" role="group" aria-label="Zoom of the timeline">
        <button
          type="button"
          aria-label="Zoom out"
          title="Zoom out (−)"
          disabled={part === null}
          onClick={() => zoomBy(1 / ZOOM_STEP)}
        >
          <Icon name="minus" />
        </button>
        <button
          type="button"
          aria-label="Zoom in"
          title="Zoom in (+), or turn the wheel, or pinch"
          disabled={empty}
          onClick={() => zoomBy(ZOOM_STEP)}
        >
          <Icon name="plus" />
        </button>
        <button
          type="button"
          aria-label="Whole time"
          title="Whole time (0)"
          disabled={part === null}
          onClick={() => setZoom(null)}
        >
          <Icon name="whole" />
        </button>
        <span className="hidden" role="status">
          {part !== null && `The timeline shows ${time(first)} to ${time(last)}`}
        </span>
      </div>
      <output>
        {frameRateHz === null ? "–" : time(frame)}{" "}
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

/** The painted timeline: wheel and pinch zoom, a drag moves it while it is zoomed, a click goes to a frame. */
function Strip({
  timelines,
  shown,
  frameRateHz,
  describe,
  onZoom,
  onPan,
  onSeek,
}: {
  timelines: readonly Timeline[];
  shown: Span;
  frameRateHz: number | null;
  describe: (frame: number) => string;
  onZoom: (factor: number, around: number) => void;
  onPan: (frames: number) => void;
  onSeek: (frame: number) => void;
}): JSX.Element {
  const canvas = useRef<HTMLCanvasElement>(null);
  const dark = useDark();
  const width = useWidth(canvas);
  useEffect(() => {
    if (canvas.current !== null) paint(canvas.current, timelines, shown, frameRateHz);
  });
  const length = shown.last - shown.first;
  const at = (share: number): number => shown.first + share * length;
  useGestures(canvas, {
    zoom: (factor, share) => onZoom(factor, at(share)),
    pan: (share) => onPan(-share * length),
    tap: (share) => onSeek(at(share)),
    hover: (share) => {
      if (canvas.current !== null) canvas.current.title = describe(at(share));
    },
  });
  return (
    <canvas
      ref={canvas}
      aria-hidden="true"
      data-first={shown.first}
      data-last={shown.last}
      data-width={width}
      data-dark={dark}
    />
  );
}

/** Everything, with the shown part framed; drag the frame. */
function Overview({
  timeline,
  whole,
  part,
  frameRateHz,
  onMove,
}: {
  timeline: Timeline | null;
  whole: Span;
  part: Span;
  frameRateHz: number | null;
  onMove: (frames: number) => void;
}): JSX.Element {
  const canvas = useRef<HTMLCanvasElement>(null);
  const frame = useRef<HTMLSpanElement>(null);
  const length = whole.last - whole.first;
  useEffect(() => {
    if (canvas.current !== null) paint(canvas.current, timeline === null ? [] : [timeline], whole, frameRateHz);
    const style = frame.current?.style;
    if (style === undefined) return;
    style.left = `${(100 * (part.first - whole.first)) / length}%`;
    style.width = `${(100 * (part.last - part.first)) / length}%`;
  });
  const centre = (share: number): void => onMove(whole.first + share * length - (part.first + part.last) / 2);
  useGestures(canvas, { pan: (share) => onMove(share * length), tap: centre });
  return (
    <>
      <canvas ref={canvas} />
      <span ref={frame} />
    </>
  );
}

/** Width of an element, px, kept up to date. */
function useWidth(element: { readonly current: HTMLElement | null }): number {
  const [width, setWidth] = useState(0);
  useEffect(() => {
    if (element.current === null) return;
    const observer = new ResizeObserver(([entry]) => setWidth(Math.round(entry?.contentRect.width ?? 0)));
    observer.observe(element.current);
    return () => observer.disconnect();
  }, [element]);
  return width;
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
