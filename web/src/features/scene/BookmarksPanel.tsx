/** Saved views of a capture, and videos, also through them. */

import { type JSX, useState } from "react";

import { count } from "../../shared/state/format";
import { toast } from "../../shared/state/toasts";
import { Icon } from "../../shared/ui/icons";
import { type Bookmark, readBookmarks, writeBookmarks } from "./bookmarks";
import { VideoPanel, type VideoProps } from "./VideoPanel";

export function BookmarksPanel({
  currentView,
  onView,
  ...of
}: Omit<VideoProps, "bookmarks"> & {
  currentView: () => { camera: number[]; frame: number | null };
  onView: (camera: number[], frame: number | null) => void;
}): JSX.Element {
  const { capture, job } = of;
  const [bookmarks, setBookmarks] = useState(() => readBookmarks(capture.id));
  const keep = (next: Bookmark[]): void => {
    setBookmarks(next);
    try {
      writeBookmarks(capture.id, next);
    } catch {
      toast("This browser does not allow the page to store bookmarks.", { tone: "problem" });
    }
  };
  return (
    <>
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
      </section>
      <VideoPanel {...of} bookmarks={bookmarks} />
    </>
  );
}
