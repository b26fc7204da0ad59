/** The part of a timeline that is shown, in frames: zoomed around a frame, moved, kept inside. */

export interface Span {
  first: number;
  last: number;
}

/** Fewest frames across the timeline. */
const LEAST_FRAMES = 100;
/** What one turn of the wheel, one key or one press of a button zooms by. */
export const ZOOM_STEP = 1.5;

/** Kept inside `whole`; null if it is all of it. */
function within(first: number, length: number, whole: Span): Span | null {
  const most = whole.last - whole.first;
  if (length >= most) return null;
  const at = Math.min(Math.max(first, whole.first), whole.last - length);
  return { first: Math.round(at), last: Math.round(at + length) };
}

/** `factor` times as close, with `around` staying where it is; null: everything is shown. */
export function zoomed(shown: Span | null, whole: Span, factor: number, around: number): Span | null {
  const { first, last } = shown ?? whole;
  const length = Math.max((last - first) / factor, Math.min(LEAST_FRAMES, whole.last - whole.first));
  const share = last > first ? Math.min(Math.max((around - first) / (last - first), 0), 1) : 0.5;
  return within(around - share * length, length, whole);
}

export function moved(shown: Span | null, whole: Span, frames: number): Span | null {
  return shown === null ? null : within(shown.first + frames, shown.last - shown.first, whole);
}

/** As long as before, and `frame` inside. */
export function containing(shown: Span | null, whole: Span, frame: number): Span | null {
  if (shown === null || (frame >= shown.first && frame <= shown.last)) return shown;
  return moved(shown, whole, frame > shown.last ? frame - shown.last : frame - shown.first);
}
