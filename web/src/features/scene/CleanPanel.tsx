/** Removes floaters, what is outside of a box and what is inside of an outline; each change is a version, and can be undone. */

import { type JSX, useEffect, useMemo, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction, Version } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { count } from "../../shared/state/format";
import { isEnded, storeReconstruction } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { ActionButton } from "../../shared/ui/access";
import { type Box, cut, NO_CUT, opened, SIDES } from "./cropBox";
import { LassoTool } from "./LassoTool";
import type { Viewer } from "./Viewer";

export interface CleanProps {
  viewer: Viewer | null;
  job: Reconstruction;
  /** The versions that are kept, oldest first. */
  versions: readonly Version[];
  /** Whether the newest version is shown: only that one is edited. */
  newest: boolean;
  /** Whether the scene alone is seen, by the free camera. */
  free: boolean;
  /** Whether all splats are shown. */
  whole: boolean;
}

export function CleanPanel(props: CleanProps): JSX.Element {
  const [open, setOpen] = useState(false);
  return (
    <details className="tool" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Clean</summary>
      {open && props.viewer !== null && <Cleaning {...props} viewer={props.viewer} />}
    </details>
  );
}

function Cleaning({ viewer, job, versions, newest, free, whole }: CleanProps & { viewer: Viewer }): JSX.Element {
  const [shares, setShares] = useState(NO_CUT);
  const [busy, setBusy] = useState(false);
  const bounds = viewer.bounds();
  const box = useMemo(() => (bounds === null ? null : cut(bounds, shares)), [bounds, shares]);
  const cropped = shares.some((share) => share > 0);
  useEffect(() => {
    viewer.showBox(cropped ? box : null);
    return () => viewer.showBox(null);
  }, [viewer, cropped, box]);

  const edit = async (
    begin: () => ReturnType<typeof calls.clean>,
    say: (found: Edited) => string,
  ): Promise<boolean> => {
    setBusy(true);
    const done = await attempt(async () => {
      const found = await begin();
      storeReconstruction(await calls.reconstruction(job.id)); // the next change names the version of this one
      setShares(NO_CUT);
      toast(say(found));
    });
    setBusy(false);
    return done;
  };
  const before = versions.find((one) => one.version === job.version)?.cleaned_from ?? null;
  const kept = versions.some((one) => one.version === before);
  const ready = isEnded(job) && newest && !busy;
  return (
    <>
      {!ready && !busy && (
        <p className="dim hint">The newest version of a reconstruction that has ended can be cleaned.</p>
      )}
      <ActionButton
        disabled={!ready}
        onClick={() =>
          void edit(
            () => calls.clean(job.id, { version: job.version, floaters: true, split: true, box: null, outline: null }),
            (found) =>
              `Removed ${count(found.floaters)} floaters` +
              (found.split + found.shrunk > 0 ? `, made ${count(found.split + found.shrunk)} huge splats smaller` : ""),
          )
        }
      >
        {busy ? "Cleaning…" : "Remove floaters"}
      </ActionButton>
      <fieldset className="crop">
        <legend>Crop box: cut off, in percent</legend>
        {SIDES.map((side, i) => (
          <label key={side} className="row">
            <span className="dim">{side}</span>
            <input
              type="range"
              min={0}
              max={95}
              value={Math.round(100 * (shares[i] ?? 0))}
              aria-valuetext={`${Math.round(100 * (shares[i] ?? 0))} percent`}
              onChange={(event) =>
                setShares(shares.map((share, k) => (k === i ? event.target.valueAsNumber / 100 : share)))
              }
            />
          </label>
        ))}
      </fieldset>
      <ActionButton
        disabled={!ready || !cropped || box === null}
        onClick={() => {
          if (box === null) return;
          void edit(
            () =>
              calls.clean(job.id, {
                version: job.version,
                floaters: false,
                split: true,
                box: boxOf(opened(box, shares)),
                outline: null,
              }),
            (found) => `Removed ${count(found.outside)} splats outside of the box`,
          );
        }}
      >
        Cut to the box
      </ActionButton>
      <LassoTool
        viewer={viewer}
        ready={ready}
        free={free}
        whole={whole}
        onRemove={(outline) =>
          edit(
            () => calls.clean(job.id, { version: job.version, floaters: false, split: true, box: null, outline }),
            (found) => `Removed ${count(found.outlined)} splats`,
          )
        }
      />
      <ActionButton
        disabled={!ready || !kept}
        title={
          before === null
            ? "The newest version was not cleaned"
            : kept
              ? `Back to version ${before}`
              : `Version ${before} is not kept any more`
        }
        onClick={() => {
          if (before === null) return;
          void edit(
            () => calls.revert(job.id, { version: job.version, to: before }),
            () => `The scene is as version ${before} was`,
          );
        }}
      >
        Undo
      </ActionButton>
    </>
  );
}

type Edited = Awaited<ReturnType<typeof calls.clean>>;

const boxOf = ({ low, high }: Box): { low: [number, number, number]; high: [number, number, number] } => ({
  low: [...low],
  high: [...high],
});
