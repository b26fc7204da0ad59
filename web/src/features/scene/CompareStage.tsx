/** The second scene of a comparison: beside the first, or over it with a wipe or as a difference. */

import { type JSX, useEffect, useRef } from "react";

import { count } from "../../shared/state/format";
import { ErrorMessage, Loading } from "../../shared/ui/parts";
import { DIFFERENCE_GAIN } from "./composing";
import type { Comparison } from "./useComparison";

export interface Names {
  first: string;
  second: string;
}

export function CompareStage({
  comparison,
  names,
  share,
  onShare,
}: {
  comparison: Comparison;
  names: Names;
  /** Where the line of a wipe is, a share of the width. */
  share: number;
  onShare: (share: number) => void;
}): JSX.Element {
  const { how, mount, shown, problem } = comparison;
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (box.current !== null) box.current.style.clipPath = how === "wipe" ? `inset(0 0 0 ${100 * share}%)` : "";
  }, [how, share]);
  return (
    <>
      <div
        className={`second ${how}`}
        ref={box}
        role="img"
        aria-label={`${names.second}: ${shown === null ? "nothing drawn yet" : `${count(shown.splats)} splats`}`}
      >
        <canvas ref={mount} data-version={shown?.version ?? 0} />
      </div>
      {how === "wipe" && <Divider share={share} onShare={onShare} names={names} />}
      {how === "difference" && <span className="brightened" aria-hidden="true" />}
      {how === "difference" && (
        <div className="compare">
          <span className="note">|first − second| × {DIFFERENCE_GAIN}; black where both are the same</span>
        </div>
      )}
      {(how === "side" || how === "wipe") && (
        <span className="wipe-names" aria-hidden="true">
          <b>{names.first}</b>
          <b>{names.second}</b>
        </span>
      )}
      {shown === null && how !== "paths" && (
        <div className="veil second-veil">
          {problem === null ? <Loading what={names.second} /> : <ErrorMessage text={problem} />}
        </div>
      )}
    </>
  );
}

/** A line with a handle: dragged, or moved by the arrow keys; the scene beside it is still rotated by dragging. */
function Divider({
  share,
  onShare,
  names,
}: {
  share: number;
  onShare: (share: number) => void;
  names: Names;
}): JSX.Element {
  const line = useRef<HTMLSpanElement>(null);
  useEffect(() => {
    if (line.current !== null) line.current.style.left = `${100 * share}%`;
  }, [share]);
  return (
    <>
      <span className="wipe-line handled" ref={line} aria-hidden="true" />
      <input
        className="divider"
        type="range"
        aria-label={`${names.first} on the left, ${names.second} on the right of`}
        aria-valuetext={`${Math.round(100 * share)} percent from the left`}
        min={0}
        max={1}
        step={0.01}
        value={share}
        onChange={(event) => onShare(event.target.valueAsNumber)}
      />
    </>
  );
}
