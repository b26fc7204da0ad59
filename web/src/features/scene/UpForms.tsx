/** What says which way is up, beside three clicks: the floor, which is found, or gravity. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import { vectorOf } from "./measure";
import { type Find, SearchForm } from "./ScaleForms";

export function FloorForm({ jobId, onFind }: { jobId: string; onFind: Find }): JSX.Element {
  return (
    <SearchForm
      action="Find the floor"
      onSearch={() =>
        onFind(async (revision) => {
          await calls.findUp(jobId, { revision });
          return "Found the floor";
        })
      }
    />
  );
}

export function GravityForm({ jobId, onFind }: { jobId: string; onFind: Find }): JSX.Element {
  const [text, setText] = useState("");
  const [frame, setFrame] = useState("");
  return (
    <details className="ways">
      <summary>By gravity</summary>
      <SearchForm
        action="Set by gravity"
        onSearch={() =>
          onFind(async (revision) => {
            const gravity = vectorOf(text);
            await calls.findUp(jobId, { revision, gravity, frame: frame === "" ? null : Number(frame) });
            return "Up is set by gravity";
          })
        }
      >
        <p className="dim hint">As an accelerometer on the camera measures it: x right, y down, z forward.</p>
        <label className="row">
          <span className="dim">x y z</span>
          <input
            required
            aria-label="Gravity in the axes of the camera: x, y and z"
            placeholder="0.1 9.7 0.9"
            value={text}
            onChange={(event) => setText(event.target.value)}
          />
        </label>
        <label className="row">
          <span className="dim">at frame</span>
          <input
            type="number"
            min="0"
            aria-label="Frame at which gravity was measured"
            placeholder="first"
            value={frame}
            onChange={(event) => setFrame(event.target.value)}
          />
        </label>
      </SearchForm>
    </details>
  );
}
