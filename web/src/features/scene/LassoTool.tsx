/** Draws an outline over the scene with the pointer, and removes the splats behind it. */

import { type JSX, type PointerEvent, useEffect, useRef, useState } from "react";
import { createPortal } from "react-dom";

import { count } from "../../shared/state/format";
import { ActionButton } from "../../shared/ui/access";
import { type Outline, type Point, thinnedLine } from "./lasso";
import type { Viewer } from "./Viewer";

export function LassoTool({
  viewer,
  ready,
  free,
  whole,
  onRemove,
}: {
  viewer: Viewer;
  ready: boolean;
  /** Whether the scene alone is seen, by the free camera. */
  free: boolean;
  /** Whether all splats are shown, so that those inside can be counted. */
  whole: boolean;
  /** Whether it was done. */
  onRemove: (outline: Outline) => Promise<boolean>;
}): JSX.Element {
  const [drawing, setArmed] = useState(false);
  const armed = drawing && free;
  const [line, setLine] = useState<readonly Point[]>([]);
  const [found, setFound] = useState<{ outline: Outline; splats: number } | null>(null);
  const forget = (): void => {
    setLine([]);
    setFound(null);
  };
  const toggle = useRef<HTMLButtonElement>(null);
  const stage = viewer.canvas.parentElement;
  useEffect(() => {
    if (!armed) return;
    const leave = (event: KeyboardEvent): void => {
      if (event.key === "Escape") setArmed(false);
    };
    window.addEventListener("keydown", leave);
    return () => window.removeEventListener("keydown", leave);
  }, [armed]);
  const close = (): void => {
    const corners = thinnedLine(line);
    const outline = corners.length < 3 ? null : viewer.outline(corners);
    setLine(outline === null ? [] : corners);
    setFound(outline);
  };
  const remove = (): void => {
    if (found === null) return;
    const now = viewer.outline(line); // the view may have moved below the line since it was drawn
    if (now === null) forget();
    else if (now.splats === found.splats)
      void onRemove(now.outline).then((done) => {
        if (!done) return;
        toggle.current?.focus(); // the button that was pressed goes
        forget();
      });
    else setFound(now);
  };
  const overlay = armed && (
    <svg
      className="lasso"
      role="img"
      aria-label="Draw around what is to be removed"
      onPointerDown={(event) => {
        if (event.button !== 0 || !event.isPrimary) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        setFound(null);
        setLine([placeOf(event)]);
      }}
      onPointerMove={(event) => {
        if (!event.currentTarget.hasPointerCapture(event.pointerId)) return;
        const place = placeOf(event);
        setLine((before) => [...before, place]);
      }}
      onPointerUp={close}
      onPointerCancel={forget}
    >
      <polygon points={line.map(([x, y]) => `${x},${y}`).join(" ")} />
    </svg>
  );
  return (
    <fieldset className="crop">
      <legend>Lasso</legend>
      <ActionButton
        ref={toggle}
        disabled={(!ready || !free) && !armed}
        title={free ? undefined : "Leave the comparison or the ride along first"}
        aria-pressed={armed}
        onClick={() => {
          forget();
          setArmed(!armed);
        }}
      >
        {armed ? "Stop drawing" : "Draw around splats"}
      </ActionButton>
      {armed && found === null && <p className="dim hint">Draw a line around them in the scene; Escape ends it.</p>}
      {armed && found !== null && (
        <ActionButton disabled={!ready || (whole && found.splats === 0)} onClick={remove}>
          {!whole
            ? "Remove the splats inside"
            : found.splats === 0
              ? "No splats inside"
              : `Remove ${count(found.splats)} splats`}
        </ActionButton>
      )}
      {stage !== null && createPortal(overlay, stage)}
    </fieldset>
  );
}

const placeOf = (event: PointerEvent<SVGSVGElement>): Point => {
  const box = event.currentTarget.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
};
