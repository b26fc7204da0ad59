/** What gives a scene metres: a known length, a tag, a board, or the distance of two cameras. */

import { type JSX, type ReactNode, useState } from "react";

import * as calls from "../../shared/api/calls";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton } from "../../shared/ui/access";
import { MARKERS } from "./measure";

/** Carries a search out on the scale of a revision, and says what it found; a refusal is shown. */
export type Find = (search: (revision: number) => Promise<string>) => Promise<void>;

export function KnownLength({
  units,
  error,
  onLength,
}: {
  units: number;
  /** Of a point that is clicked, in units: one pixel. */
  error: number;
  onLength: (metresPerUnit: number, sigma: number) => Promise<void>;
}): JSX.Element {
  const [metres, setMetres] = useState("");
  const length = Number(metres);
  return (
    <SearchForm
      action="Set the scale"
      ready={length > 0 && units !== 0}
      onSearch={() => onLength(length / units, Math.min((Math.SQRT2 * error) / units, 1))}
    >
      <Metres before="It is" label="Known length in metres" value={metres} onChange={setMetres} />
    </SearchForm>
  );
}

export function TagForm({ jobId, onFind }: { jobId: string; onFind: Find }): JSX.Element {
  const [side, setSide] = useState("0.10");
  return (
    <SearchForm
      action="Find it"
      onSearch={() =>
        onFind(async (revision) => {
          const { tags } = await calls.scaleByTag(jobId, { revision, side_m: Number(side), family: "36h11" });
          return `Found ${tags.map((one) => `tag ${one.tag} in ${one.views} views`).join(", ")}`;
        })
      }
    >
      <Metres before="AprilTag of" label="Side of the tag's black square in metres" value={side} onChange={setSide} />
    </SearchForm>
  );
}

export function BoardForm({ jobId, onFind }: { jobId: string; onFind: Find }): JSX.Element {
  const [columns, setColumns] = useState("9");
  const [rows, setRows] = useState("6");
  const [square, setSquare] = useState("0.03");
  const [dictionary, setDictionary] = useState("4x4_100");
  return (
    <SearchForm
      action="Find the board"
      onSearch={() =>
        onFind(async (revision) => {
          const board = `${columns}x${rows}`;
          return `Found the board in ${
            (await calls.scaleByBoard(jobId, { revision, board, square_m: Number(square), dictionary })).views
          } views`;
        })
      }
    >
      <span className="row">
        <span className="dim">ChArUco board</span>
        <Squares label="Squares of the board in a row" value={columns} onChange={setColumns} />
        <span className="dim">×</span>
        <Squares label="Squares of the board in a column" value={rows} onChange={setRows} />
      </span>
      <Metres before="squares of" label="Side of a square of the board in metres" value={square} onChange={setSquare} />
      <label className="row">
        <span className="dim">Markers</span>
        <select value={dictionary} onChange={(event) => setDictionary(event.target.value)}>
          {MARKERS.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
    </SearchForm>
  );
}

/** For a map that has the paths of several cameras; it says how to come to one where it has not. */
export function BaselineForm({ jobId, onFind }: { jobId: string; onFind: Find }): JSX.Element | null {
  const { value: paths, problem } = useFetch(jobId, () => calls.paths(jobId));
  const [baseline, setBaseline] = useState("");
  const [offset, setOffset] = useState("");
  const [path, setPath] = useState(1);
  if (problem !== null) return <p className="problem">{problem}</p>;
  if (paths === null) return null;
  if (paths.length < 2)
    return (
      <p className="dim hint">
        By the distance of two cameras on one rig: record both at once, reconstruct each, and merge the two on the
        Captures page.
      </p>
    );
  return (
    <SearchForm
      action="Set by the distance"
      onSearch={() =>
        onFind(async (revision) => {
          const offset_s = offset === "" ? null : Number(offset);
          const body = { revision, baseline_m: Number(baseline), path, offset_s };
          return `Both cameras have a pose at ${(await calls.scaleByBaseline(jobId, body)).poses} moments`;
        })
      }
    >
      <Metres
        before="Two cameras apart"
        label="Distance of the two cameras in metres"
        value={baseline}
        onChange={setBaseline}
      />
      {paths.length > 2 && (
        <label className="row">
          <span className="dim">The second is</span>
          <select value={path} onChange={(event) => setPath(Number(event.target.value))}>
            {paths.slice(1).map((one) => (
              <option key={one.path} value={one.path}>
                path {one.path}
              </option>
            ))}
          </select>
        </label>
      )}
      <label className="row">
        <span className="dim">Second later by</span>
        <input
          type="number"
          step="any"
          aria-label="Seconds by which the second camera began later"
          placeholder="clocks"
          title="Empty: by the clocks of both recordings"
          value={offset}
          onChange={(event) => setOffset(event.target.value)}
        />
        <span className="dim">s</span>
      </label>
    </SearchForm>
  );
}

/** A form whose search takes a while. */
export function SearchForm({
  action,
  ready = true,
  onSearch,
  children,
}: {
  action: string;
  ready?: boolean;
  onSearch: () => Promise<void>;
  children?: ReactNode;
}): JSX.Element {
  const [busy, setBusy] = useState(false);
  return (
    <form
      className="row measure-form"
      onSubmit={(event) => {
        event.preventDefault();
        setBusy(true);
        void onSearch().finally(() => setBusy(false));
      }}
    >
      {children}
      <ActionButton type="submit" disabled={busy || !ready}>
        {busy ? "Searching…" : action}
      </ActionButton>
    </form>
  );
}

interface Entry {
  label: string;
  value: string;
  onChange: (value: string) => void;
}

function Metres({ before, label, value, onChange }: Entry & { before: string }): JSX.Element {
  return (
    <label className="row">
      <span className="dim">{before}</span>
      <input
        type="number"
        min="0.0001"
        step="any"
        required
        aria-label={label}
        value={value}
        onChange={(event) => onChange(event.target.value)}
      />
      <span className="dim">m</span>
    </label>
  );
}

function Squares({ label, value, onChange }: Entry): JSX.Element {
  return (
    <input
      type="number"
      className="squares"
      min="3"
      max="60"
      required
      aria-label={label}
      value={value}
      onChange={(event) => onChange(event.target.value)}
    />
  );
}
