/** Saved views of a capture, stored by this browser. */

export interface Bookmark {
  name: string;
  /** As `Viewer.view` gives it. */
  camera: number[];
  frame: number | null;
  /** Whose scene it is a view of; unknown of those of an earlier release. */
  reconstruction?: string;
}

const MOST = 50;
const keyOf = (captureId: string): string => `spiked.bookmarks.${captureId}`;

export function readBookmarks(captureId: string): Bookmark[] {
  try {
    const value: unknown = JSON.parse(localStorage.getItem(keyOf(captureId)) ?? "[]");
    return Array.isArray(value) ? value.filter(isBookmark) : [];
  } catch {
    return []; // storage is forbidden, or holds other data
  }
}

export function writeBookmarks(captureId: string, bookmarks: readonly Bookmark[]): void {
  localStorage.setItem(keyOf(captureId), JSON.stringify(bookmarks.slice(-MOST)));
}

function isBookmark(value: unknown): value is Bookmark {
  if (typeof value !== "object" || value === null) return false;
  const { name, camera, frame } = value as Partial<Record<keyof Bookmark, unknown>>;
  return (
    typeof name === "string" &&
    Array.isArray(camera) &&
    camera.length === 7 &&
    camera.every((x) => typeof x === "number" && Number.isFinite(x)) &&
    (frame === null || typeof frame === "number")
  );
}
