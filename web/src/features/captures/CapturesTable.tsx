/** The table of captures, newest first, searched by the service. */

import { type JSX, useEffect, useState } from "react";

import { address, captures as fetchCaptures } from "../../shared/api/calls";
import type { Capture } from "../../shared/api/types";
import { lengthOf, nameOf, sourceOf } from "../../shared/state/capture";
import { bytes, when } from "../../shared/state/format";
import { adjust, go, useRoute } from "../../shared/state/route";
import { loadReconstructions, newestReconstruction, useService, errorText } from "../../shared/state/store";
import { ActionButton } from "../../shared/ui/access";
import { Icon } from "../../shared/ui/icons";
import { PageLink } from "../../shared/ui/PageLink";
import { CaptureBadge, Empty, ErrorMessage, JobBadge, JobReason, Loading } from "../../shared/ui/parts";
import { Table } from "../../shared/ui/Table";
import { filtered, type Filter, type Order, sorted } from "./listing";
import { DeletedBar, ListControls, SelectionBar } from "./SelectionBar";
import { removeWithUndo, restored } from "./remove";
import { UploadPanel } from "./UploadPanel";

const ROWS = 50;
const TYPING_MS = 200;

const COLUMNS = [
  { name: "Select", hidden: true },
  { name: "Picture", hidden: true },
  { name: "Name" },
  { name: "Started" },
  { name: "Length", number: true },
  { name: "Size", number: true },
  { name: "Verdict" },
  { name: "Reconstruction" },
  { name: "Actions", hidden: true },
];

interface Listed {
  search: string;
  deleted: boolean;
  items: Capture[];
  cursor: string | null;
}

export function CapturesTable(): JSX.Element {
  const { search } = useRoute();
  const [listed, setListed] = useState<Listed | null>(null);
  const [problem, setProblem] = useState<string | null>(null);
  const [round, setRound] = useState(0);
  const [uploads, setUploads] = useState(false);
  const [selected, setSelected] = useState<ReadonlySet<string>>(new Set());
  const [filter, setFilter] = useState<Filter>("");
  const [order, setOrder] = useState<Order>("newest");
  const known = useService((state) => state.captures);
  const newest = Object.keys(known).sort().at(-1);
  const deleted = filter === "deleted";

  useEffect(() => {
    let current = true;
    const timer = setTimeout(() => {
      fetchCaptures({ limit: ROWS, q: search, deleted }).then(
        (page) => {
          if (!current) return;
          setListed({ search, deleted, items: page.items, cursor: page.next_cursor });
          setProblem(null);
        },
        (error: unknown) => current && setProblem(errorText(error)),
      );
    }, TYPING_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [search, deleted, round, newest]);

  const more = async (): Promise<void> => {
    if (listed?.cursor == null) return;
    try {
      const page = await fetchCaptures({
        limit: ROWS,
        q: listed.search,
        deleted: listed.deleted,
        cursor: listed.cursor,
      });
      setListed({ ...listed, items: [...listed.items, ...page.items], cursor: page.next_cursor });
    } catch (error) {
      setProblem(errorText(error));
    }
  };

  const Bar = deleted ? DeletedBar : SelectionBar;
  const shown = listed === null ? [] : sorted(filtered(listed.items, filter), order);
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
            setFilter(wanted);
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
      {uploads && <UploadPanel onClose={() => setUploads(false)} />}
      {selected.size > 0 && (
        <Bar
          key={filter}
          chosen={shown.filter((one) => selected.has(one.id)).map((one) => known[one.id] ?? one)}
          onDone={() => {
            setSelected(new Set());
            setRound((n) => n + 1);
          }}
          onNone={() => setSelected(new Set())}
        />
      )}
      {problem !== null && <ErrorMessage text={problem} again={() => setRound((n) => n + 1)} />}
      {listed === null && problem === null && <Loading what="captures" />}
      {listed !== null &&
        (listed.items.length === 0 ? (
          listed.deleted && listed.search === "" ? (
            <Empty icon="trash" title="Nothing is deleted">
              <button onClick={() => setFilter("")}>Show all</button>
            </Empty>
          ) : listed.search === "" ? (
            <Empty icon="captures" title="No captures yet">
              <button onClick={() => go({ page: "live" })}>Start one</button>
            </Empty>
          ) : (
            <Empty icon="search" title={`No capture matches “${listed.search}”`}>
              <button onClick={() => adjust({ search: "" })}>Show all</button>
            </Empty>
          )
        ) : (
          <Table
            label="Table of captures"
            className="list"
            columns={COLUMNS}
            below={
              listed.cursor !== null && (
                <button type="button" className="more" onClick={() => void more()}>
                  Show more
                </button>
              )
            }
          >
            {shown.map((one) => (
              <Row
                key={one.id}
                capture={known[one.id] ?? one}
                selected={selected.has(one.id)}
                onSelect={(wanted) =>
                  setSelected((old) => new Set(wanted ? [...old, one.id] : [...old].filter((id) => id !== one.id)))
                }
                onRemoved={() =>
                  setListed((old) => old && { ...old, items: old.items.filter((item) => item.id !== one.id) })
                }
                onRestored={() => setRound((n) => n + 1)}
              />
            ))}
          </Table>
        ))}
    </div>
  );
}

function Row({
  capture,
  selected,
  onSelect,
  onRemoved,
  onRestored,
}: {
  capture: Capture;
  selected: boolean;
  onSelect: (wanted: boolean) => void;
  onRemoved: () => void;
  onRestored: () => void;
}): JSX.Element {
  const job = useService((state) => newestReconstruction(state.reconstructions, capture.id));
  const jobs = capture.reconstruction_ids.length;
  const unknown = job === null && jobs > 0;
  useEffect(() => {
    if (unknown) loadReconstructions(capture.id).catch(() => undefined); // shown by the banner at the top
  }, [unknown, capture.id]);
  return (
    <tr>
      <td>
        <input
          type="checkbox"
          aria-label={`Select ${nameOf(capture)}`}
          checked={selected}
          onChange={(event) => onSelect(event.target.checked)}
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
            onClick={() => void removeWithUndo(capture, onRemoved, onRestored)}
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
}

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
