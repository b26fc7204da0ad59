/** What is done to many captures at once, and how the list is filtered and sorted. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Capture, Reconstruction } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { bytes } from "../../shared/state/format";
import { removeFromStore, storeCapture, storeReconstruction } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { ActionButton } from "../../shared/ui/access";
import type { Filter, Order } from "./useListing";

/** All that the heads of the columns give; these are not in sight on a phone. */
const ORDERS: readonly (Order & { label: string })[] = [
  { sort: "started", descending: true, label: "newest first" },
  { sort: "started", descending: false, label: "oldest first" },
  { sort: "name", descending: false, label: "by name" },
  { sort: "name", descending: true, label: "by name, from Z" },
  { sort: "size", descending: true, label: "largest first" },
  { sort: "size", descending: false, label: "smallest first" },
  { sort: "length", descending: true, label: "longest first" },
  { sort: "length", descending: false, label: "shortest first" },
  { sort: "verdict", descending: true, label: "best verdict first" },
  { sort: "verdict", descending: false, label: "worst verdict first" },
  { sort: "reconstruction", descending: true, label: "by reconstruction" },
  { sort: "reconstruction", descending: false, label: "not reconstructed first" },
];

export function ListControls({
  filter,
  onFilter,
  order,
  onOrder,
}: {
  filter: Filter;
  onFilter: (filter: Filter) => void;
  order: Order;
  onOrder: (order: Order) => void;
}): JSX.Element {
  return (
    <>
      <select aria-label="Filter" value={filter} onChange={(event) => onFilter(event.target.value as Filter)}>
        <option value="">all</option>
        <option value="good">good</option>
        <option value="degraded">degraded</option>
        <option value="bad">bad</option>
        <option value="kept">kept</option>
        <option value="deleted">deleted</option>
      </select>
      <select
        aria-label="Order"
        value={ORDERS.findIndex((one) => one.sort === order.sort && one.descending === order.descending)}
        onChange={(event) => onOrder(ORDERS[Number(event.target.value)] ?? order)}
      >
        {ORDERS.map((one, at) => (
          <option key={one.label} value={at}>
            {one.label}
          </option>
        ))}
      </select>
    </>
  );
}

interface Selection {
  chosen: readonly Capture[];
  /** The reconstruction of a capture whose scene is shown. */
  jobOf: (captureId: string) => Reconstruction | null;
  onDone: () => void;
  onNone: () => void;
}

/** Whether a change is under way, and what makes one of all chosen captures in turn; it tells those that were changed. */
function useEach(
  chosen: readonly Capture[],
  onDone: () => void,
): [boolean, (change: (capture: Capture) => Promise<unknown>) => Promise<Capture[]>] {
  const [busy, setBusy] = useState(false);
  const each = async (change: (capture: Capture) => Promise<unknown>): Promise<Capture[]> => {
    const changed: Capture[] = [];
    setBusy(true);
    for (const one of chosen) if (await attempt(() => change(one))) changed.push(one);
    setBusy(false);
    onDone();
    return changed;
  };
  return [busy, each];
}

export function SelectionBar({ chosen, jobOf, onDone, onNone }: Selection): JSX.Element {
  const [busy, each] = useEach(chosen, onDone);
  const remove = async (): Promise<void> => {
    const removed = await each(async (one) => {
      await calls.removeCapture(one.id);
      removeFromStore(one.id);
    });
    const undo = async (): Promise<void> => {
      for (const one of removed) storeCapture(await calls.restoreCapture(one.id));
      onDone();
    };
    if (removed.length === 0) return;
    toast(`Deleted ${removed.length} ${removed.length === 1 ? "capture" : "captures"}`, {
      action: { label: "Undo", run: () => void attempt(undo) },
    });
  };
  const recorded = chosen.filter((one) => one.recording !== null);
  const results = chosen.flatMap((one) => {
    const job = jobOf(one.id);
    return job !== null && job.version > 0 ? [job.id] : [];
  });
  return (
    <div className="selection" role="group" aria-label="Selected captures">
      <strong>{chosen.length} selected</strong>
      <ActionButton
        disabled={busy}
        onClick={() => void each(async (one) => storeCapture(await calls.changeCapture(one.id, { keep: true })))}
      >
        Keep
      </ActionButton>
      <ActionButton
        disabled={busy || recorded.length < chosen.length}
        title={recorded.length < chosen.length ? "Needs complete recordings" : "With the usual options"}
        onClick={() => void each(async (one) => storeReconstruction(await calls.submit(one.id, {})))}
      >
        Re-run
      </ActionButton>
      <button
        type="button"
        disabled={recorded.length === 0}
        onClick={() => download(recorded.map((one) => calls.address.recording(one.id)))}
      >
        Download
      </button>
      <button
        type="button"
        disabled={results.length === 0}
        title="All files of the newest reconstruction of each, as ZIP"
        onClick={() => download(results.map(calls.address.bundle))}
      >
        Results
      </button>
      <ActionButton disabled={busy} onClick={() => void remove()}>
        Delete
      </ActionButton>
      <button type="button" onClick={onNone}>
        Select none
      </button>
    </div>
  );
}

/** Of deleted captures: bring them back, or free their disk space. */
export function DeletedBar({ chosen, onDone, onNone }: Selection): JSX.Element {
  const [busy, each] = useEach(chosen, onDone);
  const [asked, setAsked] = useState(false);
  const size = chosen.reduce((sum, one) => sum + (one.recording?.bytes ?? 0), 0);
  return (
    <div className="selection" role="group" aria-label="Selected captures">
      <strong>{asked ? `Delete ${chosen.length} for good?` : `${chosen.length} selected`}</strong>
      <span className="dim">{bytes(size)} of recordings</span>
      {asked ? (
        <>
          <ActionButton disabled={busy} onClick={() => void each((one) => calls.purgeCapture(one.id))}>
            Yes, free the disk space
          </ActionButton>
          <button type="button" onClick={() => setAsked(false)}>
            No
          </button>
        </>
      ) : (
        <>
          <ActionButton
            disabled={busy}
            onClick={() => void each(async (one) => storeCapture(await calls.restoreCapture(one.id)))}
          >
            Restore
          </ActionButton>
          <ActionButton disabled={busy} onClick={() => setAsked(true)}>
            Delete for good
          </ActionButton>
          <button type="button" onClick={onNone}>
            Select none
          </button>
        </>
      )}
    </div>
  );
}

/** Files, one after the other: browsers ask once whether a page may do that. */
function download(addresses: readonly string[]): void {
  addresses.forEach((address, i) => {
    setTimeout(() => {
      const link = document.createElement("a");
      link.href = address;
      link.download = "";
      link.click();
    }, 400 * i);
  });
}
