/** The table of captures, newest first, searched by the service. */

import { type JSX, useEffect, useState } from "react";

import { address, captures as ask } from "../api/calls";
import type { Capture } from "../api/types";
import { lengthOf, nameOf, sourceOf } from "../state/capture";
import { bytes, when } from "../state/format";
import { adjust, go, useRoute } from "../state/route";
import { loadReconstructions, newestReconstruction, useService, wordsOf } from "../state/store";
import { Icon } from "../ui/icons";
import { Badge, captureTone, Empty, gradeTone, jobTone, Loading, Trouble } from "../ui/parts";
import { removeWithUndo } from "./remove";

const ROWS = 50;
const TYPING_MS = 200;

interface Listed {
  search: string;
  items: Capture[];
  cursor: string | null;
}

export function CapturesTable(): JSX.Element {
  const { search } = useRoute();
  const [listed, setListed] = useState<Listed | null>(null);
  const [problem, setProblem] = useState<string | null>(null);
  const [round, setRound] = useState(0);
  const known = useService((state) => state.captures);
  const newest = Object.keys(known).sort().at(-1);

  useEffect(() => {
    let current = true;
    const timer = setTimeout(() => {
      ask({ limit: ROWS, q: search }).then(
        (page) => {
          if (!current) return;
          setListed({ search, items: page.items, cursor: page.next_cursor });
          setProblem(null);
        },
        (error: unknown) => current && setProblem(wordsOf(error)),
      );
    }, TYPING_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [search, round, newest]);

  const more = async (): Promise<void> => {
    if (listed?.cursor == null) return;
    try {
      const page = await ask({ limit: ROWS, q: listed.search, cursor: listed.cursor });
      setListed({ ...listed, items: [...listed.items, ...page.items], cursor: page.next_cursor });
    } catch (error) {
      setProblem(wordsOf(error));
    }
  };

  return (
    <div className="captures">
      <header className="head">
        <h1>Captures</h1>
        <label className="search">
          <Icon name="search" />
          <span className="hidden">Search captures</span>
          <input
            type="search"
            placeholder="Search name, notes, source"
            value={search}
            onChange={(event) => adjust({ search: event.target.value })}
          />
        </label>
      </header>
      {problem !== null && <Trouble text={problem} again={() => setRound((n) => n + 1)} />}
      {listed === null && problem === null && <Loading what="captures" />}
      {listed !== null &&
        (listed.items.length === 0 ? (
          listed.search === "" ? (
            <Empty icon="captures" title="No captures yet">
              <button onClick={() => go({ page: "live" })}>Start one</button>
            </Empty>
          ) : (
            <Empty icon="search" title={`Nothing is found for “${listed.search}”`}>
              <button onClick={() => adjust({ search: "" })}>Show all</button>
            </Empty>
          )
        ) : (
          <div className="scroll" role="region" aria-label="Table of captures" tabIndex={0}>
            <table className="list">
              <thead>
                <tr>
                  <th scope="col">
                    <span className="hidden">Picture</span>
                  </th>
                  <th scope="col">Name</th>
                  <th scope="col">Started</th>
                  <th scope="col" className="number">
                    Length
                  </th>
                  <th scope="col" className="number">
                    Size
                  </th>
                  <th scope="col">Verdict</th>
                  <th scope="col">Reconstruction</th>
                  <th scope="col">
                    <span className="hidden">Actions</span>
                  </th>
                </tr>
              </thead>
              <tbody>
                {listed.items.map((one) => (
                  <Row
                    key={one.id}
                    capture={known[one.id] ?? one}
                    onRemoved={() =>
                      setListed((old) => old && { ...old, items: old.items.filter((item) => item.id !== one.id) })
                    }
                    onRestored={() => setRound((n) => n + 1)}
                  />
                ))}
              </tbody>
            </table>
            {listed.cursor !== null && (
              <button type="button" className="more" onClick={() => void more()}>
                Show more
              </button>
            )}
          </div>
        ))}
    </div>
  );
}

function Row({
  capture,
  onRemoved,
  onRestored,
}: {
  capture: Capture;
  onRemoved: () => void;
  onRestored: () => void;
}): JSX.Element {
  const job = useService((state) => newestReconstruction(state.reconstructions, capture.id));
  const jobs = capture.reconstruction_ids.length;
  const unknown = job === null && jobs > 0;
  useEffect(() => {
    if (unknown) loadReconstructions(capture.id).catch(() => undefined); // the band at the top tells
  }, [unknown, capture.id]);
  const href = `./?page=captures&capture=${capture.id}`;
  return (
    <tr>
      <td>
        <Thumbnail id={capture.id} />
      </td>
      <th scope="row">
        <a
          href={href}
          onClick={(event) => {
            if (event.ctrlKey || event.metaKey || event.shiftKey) return;
            event.preventDefault();
            go({ page: "captures", capture: capture.id });
          }}
        >
          {nameOf(capture)}
        </a>
        <span className="dim">
          {capture.name !== "" && <span title={capture.source}>{sourceOf(capture)}</span>}
          {capture.name !== "" && capture.keep && " · "}
          {capture.keep && "kept"}
        </span>
      </th>
      <td>{when(capture.started_at)}</td>
      <td className="number">{lengthOf(capture)}</td>
      <td className="number">{capture.recording === null ? "–" : bytes(capture.recording.bytes)}</td>
      <td>
        {capture.verdict === null ? (
          <Badge tone={captureTone[capture.state]}>{capture.state}</Badge>
        ) : (
          <Badge tone={gradeTone[capture.verdict.grade]}>{capture.verdict.grade}</Badge>
        )}
      </td>
      <td>
        {job === null ? (
          <span className="dim">{jobs === 0 ? "not reconstructed" : "…"}</span>
        ) : (
          <Badge tone={jobTone[job.state]}>{job.state === "running" ? job.stage : job.state}</Badge>
        )}
        {jobs > 1 && job !== null && <span className="dim"> of {jobs}</span>}
      </td>
      <td className="number">
        <button
          type="button"
          className="bare"
          aria-label={`Delete ${nameOf(capture)}`}
          title="Delete"
          onClick={() => void removeWithUndo(capture, onRemoved, onRestored)}
        >
          <Icon name="trash" />
        </button>
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
