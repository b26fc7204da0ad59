/** Deleting is undone for as long as the service keeps what was deleted. */

import { removeCapture, restoreCapture } from "../api/calls";
import type { Capture } from "../api/types";
import { nameOf } from "../state/capture";
import { forgetCapture, takeCapture, wordsOf } from "../state/store";
import { toast } from "../state/toasts";

export async function removeWithUndo(capture: Capture, onRemoved: () => void, onRestored: () => void): Promise<void> {
  try {
    await removeCapture(capture.id);
  } catch (error) {
    toast(wordsOf(error), { tone: "problem" });
    return;
  }
  forgetCapture(capture.id);
  onRemoved();
  const undo = async (): Promise<void> => {
    try {
      takeCapture(await restoreCapture(capture.id));
      onRestored();
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
    }
  };
  toast(`Deleted ${nameOf(capture)}`, { action: { label: "Undo", run: () => void undo() } });
}
