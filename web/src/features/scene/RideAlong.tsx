/** The capture camera's view: observed image over rendered scene, with a wipe or the difference. */

import { type JSX, useEffect, useRef, useState } from "react";

import { address, fetched } from "../../shared/api/calls";
import type { Capture, Sensor } from "../../shared/api/types";
import { Segmented } from "../../shared/ui/parts";
import { DIFFERENCE_GAIN } from "./composing";

export type Comparison = "wipe" | "difference" | "rendered" | "observed";
const CHOICES = [
  { value: "wipe", label: "Wipe" },
  { value: "difference", label: "Difference" },
  { value: "rendered", label: "Rendered" },
  { value: "observed", label: "Observed" },
] as const;
/** The one that the address names; a wipe if it names none. */
export const comparisonOf = (how: string): Comparison => CHOICES.find(({ value }) => value === how)?.value ?? "wipe";

const LOOK_MS = 60;

export function RideAlong({
  capture,
  jobId,
  version,
  white,
  sensor,
  frame,
  comparison,
  onComparison,
  share,
  onShare,
}: {
  capture: Capture;
  /** The reconstruction, whose optics the picture has to have, too. */
  jobId: string;
  /** Its version; undefined: the newest. */
  version: number | undefined;
  /** Radiance of white in the scene. */
  white: number | undefined;
  sensor: Sensor;
  frame: number | null;
  comparison: Comparison;
  onComparison: (comparison: Comparison) => void;
  /** Where the line of the wipe is, a share of the width. */
  share: number;
  onShare: (share: number) => void;
}): JSX.Element {
  const image = useRef<HTMLImageElement>(null);
  const observed = useObserved(capture.id, jobId, version, white, frame);
  const bar = useRef<HTMLDivElement>(null);
  useAspectFit(bar, sensor.width / sensor.height);

  useEffect(() => {
    const style = image.current?.style;
    if (style === undefined) return;
    style.clipPath = comparison === "wipe" ? `inset(0 ${100 * (1 - share)}% 0 0)` : "";
    style.mixBlendMode = comparison === "difference" ? "difference" : "normal";
    style.visibility = comparison === "rendered" ? "hidden" : "visible";
  }, [comparison, share, observed.url]);

  return (
    <>
      {observed.url !== null && (
        <img
          ref={image}
          className="observed"
          src={observed.url}
          alt="Observed by the camera"
          data-frame={frame ?? ""}
        />
      )}
      {comparison === "wipe" && <Wipe share={share} onShare={onShare} />}
      {comparison === "difference" && <span className="brightened" aria-hidden="true" />}
      <div className="compare" ref={bar}>
        <Segmented label="Comparison" value={comparison} choices={CHOICES} onChange={onComparison} />
        {comparison === "difference" && <span className="note">|observed − rendered| × {DIFFERENCE_GAIN}</span>}
        {observed.missing && comparison !== "rendered" && (
          <span className="note">No recorded picture of this frame</span>
        )}
        {sensor.intrinsics === null && <span className="note">The intrinsics of this capture are unknown</span>}
      </div>
    </>
  );
}

function Wipe({ share, onShare }: { share: number; onShare: (share: number) => void }): JSX.Element {
  const line = useRef<HTMLSpanElement>(null);
  useEffect(() => {
    if (line.current !== null) line.current.style.left = `${100 * share}%`;
  }, [share]);
  return (
    <>
      <span className="wipe-line" ref={line} aria-hidden="true" />
      <span className="wipe-names" aria-hidden="true">
        <b>observed</b>
        <b>rendered</b>
      </span>
      <input
        className="wipe"
        type="range"
        aria-label="Observed on the left, rendered on the right of"
        min={0}
        max={1}
        step={0.01}
        value={share}
        onChange={(event) => onShare(event.target.valueAsNumber)}
      />
    </>
  );
}

const stageOf = (inside: HTMLElement | null): HTMLElement | null => inside?.closest<HTMLElement>(".stage") ?? null;

/** Fit the stage into its container at the aspect ratio of the sensor; reset on unmount. */
function useAspectFit(inside: { readonly current: HTMLElement | null }, aspect: number): void {
  useEffect(() => {
    const box = stageOf(inside.current);
    const around = box?.parentElement;
    if (box === null || around == null) return;
    const fit = (): void => {
      const width = Math.min(around.clientWidth, around.clientHeight * aspect);
      box.style.width = `${Math.floor(width)}px`;
      box.style.height = `${Math.floor(width / aspect)}px`;
    };
    const observer = new ResizeObserver(fit);
    observer.observe(around);
    fit();
    return () => {
      observer.disconnect();
      box.style.width = box.style.height = "";
    };
  }, [inside, aspect]);
}

/**
 * The observed picture of a frame, at the brightness of the scene. Frames may change faster than pictures arrive: one
 * request runs at a time, for the newest frame.
 */
function useObserved(
  captureId: string,
  jobId: string,
  version: number | undefined,
  white: number | undefined,
  frame: number | null,
): { url: string | null; missing: boolean } {
  const [url, setUrl] = useState<string | null>(null);
  const [missing, setMissing] = useState(false);
  const wanted = useRef(frame);
  useEffect(() => {
    wanted.current = frame;
  }, [frame]);
  useEffect(() => {
    const ended = new AbortController();
    let shown: number | null = null;
    const show = (next: string | null): void =>
      setUrl((before) => {
        if (before !== null) URL.revokeObjectURL(before);
        return next;
      });
    let busy = false;
    const ask = async (): Promise<void> => {
      const requested = wanted.current;
      if (busy || requested === null || requested === shown) return;
      busy = true;
      shown = requested;
      try {
        const picture = address.preview(captureId, "interval", {
          frame: requested,
          white,
          undistorted: true,
          optics_of: jobId,
          optics_version: version,
        });
        show(URL.createObjectURL(await (await fetched(picture, ended.signal)).blob()));
        setMissing(false);
      } catch {
        if (!ended.signal.aborted) {
          setMissing(true);
          show(null); // that of another frame would be compared
        }
      }
      busy = false;
    };
    const timer = setInterval(() => void ask(), LOOK_MS);
    return () => {
      ended.abort();
      clearInterval(timer);
    };
  }, [captureId, jobId, version, white]);
  return { url, missing };
}
