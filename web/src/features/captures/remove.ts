/** Delete a capture, with undo while the service still keeps it. */

import { removeCapture, restoreCapture } from "../../shared/api/calls";
import type { Capture } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { nameOf } from "../../shared/state/capture";
import { removeFromStore, storeCapture } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";

export async function removeWithUndo(capture: Capture, onRemoved: () => void, onRestored: () => void): Promise<void> {
  if (!(await attempt(() => removeCapture(capture.id)))) return;
  removeFromStore(capture.id);
  onRemoved();
  toast(`Deleted ${nameOf(capture)}`, { action: { label: "Undo", run: () => void restored(capture, onRestored) } });
}

export async function restored(capture: Capture, onRestored: () => void): Promise<void> {
  await attempt(async () => {
    storeCapture(await restoreCapture(capture.id));
    onRestored();
  });
}
