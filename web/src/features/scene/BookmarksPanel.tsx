/** Saved views of a capture, and a video through them. */

import { type JSX, useState } from "react";

import { address } from "../../shared/api/calls";
import type { Reconstruction } from "../../shared/api/types";
import { count } from "../../shared/state/format";
import { toast } from "../../shared/state/toasts";
import { Icon } from "../../shared/ui/icons";
import { poseOfView } from "./axes";
import { type Bookmark, readBookmarks, writeBookmarks } from "./bookmarks";

/** Seconds of a video from each bookmark to the next. */
const BETWEEN_S = 3;
/** Longest video that the service makes. */
const MOST_S = 120;

/** Nothing without two bookmarks of this reconstruction: another one has a unit of length of its own. */
function videoThrough(jobId: string, version: number | null, bookmarks: readonly Bookmark[]): string | null {
  const poses = bookmarks.filter((one) => one.reconstruction === jobId).map((one) => poseOfView(one.camera));
  if (poses.length < 2) return null;
  const through = poses.map(({ position, quaternion_wxyz }) => [...position, ...quaternion_wxyz]);
  return address.video(jobId, version, through, Math.min(BETWEEN_S * (poses.length - 1), MOST_S));
}

export function BookmarksPanel({
  captureId,
  job,
  version,
  currentView,
  onView,
}: {
  captureId: string;
  job: Reconstruction;
  /** The one that is shown; null: the newest. */
  version: number | null;
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
  const video = videoThrough(job.id, version, bookmarks);
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
            keep([...bookmarks, { name: `View ${number}`, reconstruction: job.id, ...currentView() }]);
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
      {video !== null && (
        <>
          <a className="button" href={video} download>
            <Icon name="download" /> Video through them
          </a>
          <p className="dim hint">
            {BETWEEN_S} s from each to the next, with the optics of the camera. The server makes it when you ask, which
            takes about as long as the video.
          </p>
        </>
      )}
    </section>
  );
}
