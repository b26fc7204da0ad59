/** Saved views of a capture, and a video through them. */

import { type JSX, useState } from "react";

import { address } from "../../shared/api/calls";
import { count } from "../../shared/state/format";
import { toast } from "../../shared/state/toasts";
import { Icon } from "../../shared/ui/icons";
import { poseOfView } from "./axes";
import { type Bookmark, readBookmarks, writeBookmarks } from "./bookmarks";

/** Seconds of a video from each bookmark to the next. */
const BETWEEN_S = 3;
/** Longest video that the service makes. */
const MOST_S = 120;

function videoThrough(jobId: string, bookmarks: readonly Bookmark[]): string {
  const poses = bookmarks.map((one) => poseOfView(one.camera));
  const through = poses.map(({ position, quaternion_wxyz }) => [...position, ...quaternion_wxyz]);
  return address.video(jobId, through, Math.min(BETWEEN_S * (bookmarks.length - 1), MOST_S));
}

export function BookmarksPanel({
  captureId,
  jobId,
  currentView,
  onView,
}: {
  captureId: string;
  jobId: string;
  currentView: () => { camera: number[]; frame: number | null };
  onView: (camera: number[], frame: number | null) => void;
}): JSX.Element {
  const [bookmarks, setBookmarks] = useState(() => readBookmarks(captureId));
  const keep = (next: Bookmark[]): void => {
    setBookmarks(next);
    try {
      writeBookmarks(captureId, next);
    } catch {
      toast("This browser does not allow the page to store bookmarks.", { tone: "problem" });
    }
  };
  return (
    <section className="bookmarks" aria-label="Bookmarks">
      <div className="row">
        <span className="dim">Bookmarks</span>
        <button
          type="button"
          onClick={() => {
            const names = new Set(bookmarks.map((one) => one.name));
            let number = bookmarks.length + 1;
            while (names.has(`View ${number}`)) number += 1;
            keep([...bookmarks, { name: `View ${number}`, ...currentView() }]);
          }}
        >
          <Icon name="bookmark" /> Add
        </button>
      </div>
      {bookmarks.length > 0 && (
        <ul>
          {bookmarks.map((one, i) => (
            <li key={one.name}>
              <button type="button" className="bare" onClick={() => onView(one.camera, one.frame)}>
                {one.name}
                {one.frame !== null && <span className="dim"> frame {count(one.frame)}</span>}
              </button>
              <button
                type="button"
                className="bare"
                aria-label={`Remove ${one.name}`}
                onClick={() => keep(bookmarks.filter((_, k) => k !== i))}
              >
                <Icon name="close" />
              </button>
            </li>
          ))}
        </ul>
      )}
      {bookmarks.length > 1 && (
        <a
          className="button"
          href={videoThrough(jobId, bookmarks)}
          download
          title={`MP4, made on the server: ${BETWEEN_S} s from each to the next, through the optics of the camera`}
        >
          <Icon name="download" /> Video through them
        </a>
      )}
    </section>
  );
}
