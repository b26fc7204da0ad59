/** Gestures on a strip of time: wheel and pinch zoom, drag, tap, hover. Places and ways are shares of its width. */

import { useEffect, useRef } from "react";

export interface Gestures {
  zoom?: (factor: number, around: number) => void;
  pan?: (way: number) => void;
  tap?: (at: number) => void;
  hover?: (at: number) => void;
}

/** A pointer that has moved less when it is lifted has tapped, CSS px. */
const TAP_PX = 4;
/** One line of a wheel that counts in lines, CSS px. */
const LINE_PX = 16;
/** The wheel zooms by a factor of e over this way, CSS px. */
const WHEEL_PX = 250;

export function useGestures(element: { readonly current: HTMLElement | null }, gestures: Gestures): void {
  const newest = useRef(gestures);
  useEffect(() => {
    newest.current = gestures;
  });
  useEffect(() => {
    const strip = element.current;
    if (strip === null) return;
    const pointers = new Map<number, number>();
    let way = 0;
    const box = (): DOMRect => strip.getBoundingClientRect();
    const share = (x: number): number => (x - box().left) / Math.max(box().width, 1);
    const onWheel = (event: WheelEvent): void => {
      const { zoom, pan } = newest.current;
      if (zoom === undefined) return;
      event.preventDefault();
      const line = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1;
      if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY))
        pan?.((-line * (event.deltaX || event.deltaY)) / Math.max(box().width, 1));
      else zoom(Math.exp((-line * event.deltaY) / WHEEL_PX), share(event.clientX));
    };
    const onDown = (event: PointerEvent): void => {
      if (pointers.size === 0) way = 0;
      pointers.set(event.pointerId, event.clientX);
      strip.setPointerCapture(event.pointerId);
    };
    const onMove = (event: PointerEvent): void => {
      const before = pointers.get(event.pointerId);
      const { zoom, pan, hover } = newest.current;
      if (before === undefined) {
        hover?.(share(event.clientX));
        return;
      }
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      pointers.set(event.pointerId, event.clientX);
      way += Math.abs(event.clientX - before);
      const [old, now] = other === undefined ? [0, 0] : [Math.abs(before - other), Math.abs(event.clientX - other)];
      if (old > TAP_PX && now > TAP_PX && other !== undefined) zoom?.(now / old, share((event.clientX + other) / 2));
      pan?.((event.clientX - before) / Math.max(pointers.size, 1) / Math.max(box().width, 1));
    };
    const onUp = (event: PointerEvent): void => {
      if (!pointers.delete(event.pointerId)) return;
      if (event.type === "pointerup" && pointers.size === 0 && way < TAP_PX) newest.current.tap?.(share(event.clientX));
    };
    strip.addEventListener("wheel", onWheel, { passive: false });
    strip.addEventListener("pointerdown", onDown);
    strip.addEventListener("pointermove", onMove);
    strip.addEventListener("pointerup", onUp);
    strip.addEventListener("pointercancel", onUp);
    return () => {
      strip.removeEventListener("wheel", onWheel);
      strip.removeEventListener("pointerdown", onDown);
      strip.removeEventListener("pointermove", onMove);
      strip.removeEventListener("pointerup", onUp);
      strip.removeEventListener("pointercancel", onUp);
    };
  }, [element]);
}
