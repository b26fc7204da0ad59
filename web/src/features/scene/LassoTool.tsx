/** Draws an outline over the scene with the pointer, and removes the splats behind it. */

import { type JSX, type PointerEvent, useEffect, useState } from "react";
import { createPortal } from "react-dom";

import { count } from "../../shared/state/format";
import { ActionButton } from "../../shared/ui/access";
import { type Outline, type Point, thinnedLine } from "./lasso";
import type { Viewer } from "./Viewer";

export function LassoTool({
  viewer,
  ready,
  onRemove,
}: {
  viewer: Viewer;
  ready: boolean;
  onRemove: (outline: Outline) => Promise<void>;
}): JSX.Element {
  const [armed, setArmed] = useState(false);
  const [line, setLine] = useState<readonly Point[]>([]);
  const [found, setFound] = useState<{ outline: Outline; splats: number } | null>(null);
  const forget = (): void => {
    setLine([]);
    setFound(null);
  };
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
  const overlay = armed && (
    <svg
      className="lasso"
      role="img"
      aria-label="Draw around what is to be removed"
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        setFound(null);
        setLine([placeOf(event)]);
      }}
      onPointerMove={(event) => {
        if (event.currentTarget.hasPointerCapture(event.pointerId)) setLine([...line, placeOf(event)]);
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
        disabled={!ready && !armed}
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
        <ActionButton
          disabled={!ready || found.splats === 0}
          onClick={() => {
            void onRemove(found.outline).then(forget);
          }}
        >
          {found.splats === 0 ? "No splats inside" : `Remove ${count(found.splats)} splats`}
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
