/** Points of the scene, by a click on the canvas, or by Enter for the one in the middle of the view. */

import { useEffect, useRef } from "react";
import type { Vector3 } from "three";

import { toast } from "../../shared/state/toasts";
import type { Viewer } from "./Viewer";

/** A click that moves farther is a drag, px. */
const DRAG_PX = 4;

export function usePicking(viewer: Viewer, onPoint: (point: Vector3) => void): void {
  const told = useRef(onPoint);
  useEffect(() => {
    told.current = onPoint;
  });
  useEffect(() => {
    const { canvas } = viewer;
    let down = { x: 0, y: 0 };
    const pick = (x: number, y: number): void => {
      const point = viewer.pick(x, y);
      if (point === null) toast("Nothing opaque is there: click a surface.");
      else told.current(point);
    };
    const onDown = (event: PointerEvent): void => {
      down = { x: event.clientX, y: event.clientY };
    };
    const onClick = (event: MouseEvent): void => {
      if (Math.hypot(event.clientX - down.x, event.clientY - down.y) <= DRAG_PX) pick(event.clientX, event.clientY);
    };
    const onKey = (event: KeyboardEvent): void => {
      if (event.key === "Enter") pick(...viewer.middle);
    };
    canvas.addEventListener("pointerdown", onDown);
    canvas.addEventListener("click", onClick);
    canvas.addEventListener("keydown", onKey);
    canvas.classList.add("picking");
    return () => {
      canvas.removeEventListener("pointerdown", onDown);
      canvas.removeEventListener("click", onClick);
      canvas.removeEventListener("keydown", onKey);
      canvas.classList.remove("picking");
    };
  }, [viewer]);
}
