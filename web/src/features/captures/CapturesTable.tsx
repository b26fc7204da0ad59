/** The table of captures, newest first, searched by the service. */

import { type JSX, memo, useCallback, useEffect, useRef, useState } from "react";

import { address } from "../../shared/api/calls";
import type { Capture, CaptureSort, Reconstruction } from "../../shared/api/types";
import { lengthOf, nameOf, sourceOf } from "../../shared/state/capture";
import { bytes, count, when } from "../../shared/state/format";
import { adjust, go, useRoute } from "../../shared/state/route";
import { useService } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { Icon } from "../../shared/ui/icons";
import { PageLink } from "../../shared/ui/PageLink";
import { CaptureBadge, Empty, ErrorMessage, JobBadge, JobReason, Loading } from "../../shared/ui/parts";
import { type Column, Table } from "../../shared/ui/Table";
import { DeletedBar, ListControls, SelectionBar } from "./SelectionBar";
import { removeWithUndo, restored } from "./remove";
import { UnfinishedUploads } from "./UnfinishedUploads";
import { UploadPanel } from "./UploadPanel";
import { filterOf, named, type Order, orderOf, useListing } from "./useListing";
import { useShownJobs } from "./useShownJobs";

const COLUMNS: (Column & { sort?: CaptureSort })[] = [
  { name: "Select", hidden: true },
  { name: "Picture", hidden: true },
  { name: "Name", sort: "name" },
  { name: "Started", sort: "started" },
  { name: "Length", number: true, sort: "length" },
  { name: "Size", number: true, sort: "size" },
  { name: "Verdict", sort: "verdict" },
  { name: "Reconstruction", sort: "reconstruction" },
  { name: "Actions", hidden: true },
];

const NONE: Capture[] = [];

export function CapturesTable(): JSX.Element {
  const at = useRoute();
  const { search } = at;
  const [uploads, setUploads] = useState(false);
  const [selected, setSelected] = useState<ReadonlySet<string>>(new Set());
  const filter = filterOf(at);
  const order = orderOf(at);
  const setOrder = (wanted: Order): void => adjust(named(wanted));
  const { listed, problem, newer, more, again, forget } = useListing(search, filter, order);
  const known = useService((state) => state.captures);
  const deleted = filter === "deleted";

  const select = useCallback(
    (id: string, wanted: boolean) =>
      setSelected((old) => new Set(wanted ? [...old, id] : [...old].filter((one) => one !== id))),
    [],
  );
  const Bar = deleted ? DeletedBar : SelectionBar;
  const shown = listed?.items ?? NONE;
  const jobOf = useShownJobs(shown);
  return (
    <div className="captures">
      <header className="head">
        <h1>Captures</h1>
        <label className="search">
          <Icon name="search" />
          <span className="hidden">Search captures</span>
          <input
            type="search"
            placeholder="Search name, notes, tags, source"
            value={search}
            onChange={(event) => adjust({ search: event.target.value })}
          />
        </label>
        <ListControls
          filter={filter}
          onFilter={(wanted) => {
            adjust({ filter: wanted });
            setSelected(new Set());
          }}
          order={order}
          onOrder={setOrder}
        />
        {!uploads && (
          <ActionButton className="opens-upload" onClick={() => setUploads(true)}>
            Upload
          </ActionButton>
        )}
      </header>
      <UnfinishedUploads />
      {uploads && <UploadPanel onClose={() => setUploads(false)} />}
      {selected.size > 0 && (
        <Bar
          key={filter}
          chosen={shown.filter((one) => selected.has(one.id)).map((one) => known[one.id] ?? one)}
          jobOf={jobOf}
          onDone={() => {
            setSelected(new Set());
            again();
          }}
          onNone={() => setSelected(new Set())}
        />
      )}
      {problem !== null && <ErrorMessage text={problem} again={again} />}
      {newer && (
        <p className="warning" role="status">
          There are new captures.{" "}
          <button type="button" onClick={again}>
            List them, too
          </button>
        </p>
      )}
      {listed === null && problem === null && <Loading what="captures" />}
      {listed !== null &&
        (listed.items.length === 0 ? (
          listed.filter === "deleted" && listed.q === "" ? (
            <Empty icon="trash" title="Nothing is deleted">
              <button onClick={() => adjust({ filter: "" })}>Show all</button>
            </Empty>
          ) : listed.q === "" && listed.filter === "" ? (
            <Empty icon="captures" title="No captures yet">
              <button onClick={() => go({ page: "live" })}>Start one</button>
            </Empty>
          ) : (
            <Empty icon="search" title={`No capture matches “${listed.q === "" ? listed.filter : listed.q}”`}>
              <button onClick={() => adjust({ search: "", filter: "" })}>Show all</button>
            </Empty>
          )
        ) : (
          <Table
            label="Table of captures"
            className="list"
            columns={COLUMNS.map(({ sort, ...column }) =>
              sort === undefined ? column : { ...column, sorting: sortingBy(sort, order, setOrder) },
            )}
            below={
              <p className="below">
                <span className="dim" role="status">
                  {count(shown.length)} of {count(listed.total)}
                </span>
                {listed.cursor !== null && <MoreButton waits={problem !== null} onMore={more} />}
              </p>
            }
          >
            {shown.map((one) => (
              <Row
                key={one.id}
                capture={known[one.id] ?? one}
                job={jobOf(one.id)}
                selected={selected.has(one.id)}
                onSelect={select}
                onRemoved={forget}
                onRestored={again}
              />
            ))}
          </Table>
        ))}
    </div>
  );
}

/** First by what is usually looked for: the newest and largest; a second click turns the order. */
function sortingBy(sort: CaptureSort, order: Order, onOrder: (order: Order) => void): Column["sorting"] {
  const active = order.sort === sort;
  return {
    direction: active ? (order.descending ? "descending" : "ascending") : "none",
    onSort: () => onOrder({ sort, descending: active ? !order.descending : sort !== "name" }),
  };
}

/** Fetches more when it comes into view, unless it waits, or is pressed. */
function MoreButton({ waits, onMore }: { waits: boolean; onMore: () => void }): JSX.Element {
  const button = useRef<HTMLButtonElement>(null);
  const latest = useRef(onMore);
  useEffect(() => {
    latest.current = onMore;
  });
  useEffect(() => {
    if (button.current === null || waits) return; // after an error it is pressed
    const watch = new IntersectionObserver((seen) => seen.some((one) => one.isIntersecting) && latest.current());
    watch.observe(button.current);
    return () => watch.disconnect();
  });
  return (
    <button ref={button} type="button" className="more" onClick={onMore}>
      Show more
    </button>
  );
}

/** Drawn anew only if its capture or job has changed: captures that run are told of twice a second. */
const Row = memo(function Row({
  capture,
  job,
  selected,
  onSelect,
  onRemoved,
  onRestored,
}: {
  capture: Capture;
  /** The one whose scene is shown; null where none is known. */
  job: Reconstruction | null;
  selected: boolean;
  onSelect: (id: string, wanted: boolean) => void;
  onRemoved: (id: string) => void;
  onRestored: () => void;
}): JSX.Element {
  const jobs = capture.reconstruction_count;
  return (
    <tr>
      <td>
        <input
          type="checkbox"
          aria-label={`Select ${nameOf(capture)}`}
          checked={selected}
          onChange={(event) => onSelect(capture.id, event.target.checked)}
        />
      </td>
      <td>
        <Thumbnail id={capture.id} />
      </td>
      <th scope="row">
        <PageLink to={{ page: "captures", capture: capture.id }}>{nameOf(capture)}</PageLink>
        <span className="dim">
          {capture.name !== "" && <span title={capture.source}>{sourceOf(capture)}</span>}
          {capture.name !== "" && capture.keep && " · "}
          {capture.keep && "kept"}
        </span>
        {capture.group !== null && (
          <span className="dim" title={`Started together with the others of group ${capture.group}`}>
            group {capture.group.slice(-6)}
          </span>
        )}
        {capture.tags.length > 0 && <span className="dim">{capture.tags.map((tag) => `#${tag}`).join(" ")}</span>}
        {capture.notes !== "" && (
          <span className="dim notes" title={capture.notes}>
            {capture.notes}
          </span>
        )}
      </th>
      <td>
        {when(capture.started_at)}
        {capture.deleted_at !== null && <span className="dim"> · deleted {when(capture.deleted_at)}</span>}
      </td>
      <td className="number">{lengthOf(capture)}</td>
      <td className="number">{capture.recording === null ? "–" : bytes(capture.recording.bytes)}</td>
      <td>
        <CaptureBadge capture={capture} />
      </td>
      <td>
        {job === null ? <span className="dim">{jobs === 0 ? "not reconstructed" : "…"}</span> : <JobBadge job={job} />}
        {jobs > 1 && job !== null && <span className="dim"> of {jobs}</span>}
        {job !== null && <JobReason job={job} />}
      </td>
      <td className="number">
        {capture.deleted_at === null ? (
          <ActionButton
            className="bare"
            aria-label={`Delete ${nameOf(capture)}`}
            title="Delete"
            onClick={() => void removeWithUndo(capture, () => onRemoved(capture.id), onRestored)}
          >
            <Icon name="trash" />
          </ActionButton>
        ) : (
          <ActionButton aria-label={`Restore ${nameOf(capture)}`} onClick={() => void restored(capture, onRestored)}>
            Restore
          </ActionButton>
        )}
      </td>
    </tr>
  );
});

function Thumbnail({ id }: { id: string }): JSX.Element {
  const [missing, setMissing] = useState(false);
  return missing ? (
    <span className="thumb none" aria-hidden="true">
      <Icon name="camera" />
    </span>
  ) : (
    <img className="thumb" src={address.thumbnail(id)} alt="" loading="lazy" onError={() => setMissing(true)} />
  );
}
