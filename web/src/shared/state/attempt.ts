/** Actions whose errors are shown as toasts. */

import { errorText } from "./store";
import { toast } from "./toasts";

/** Run an action; an error is shown. Returns whether it succeeded. */
export async function attempt(action: () => Promise<unknown>): Promise<boolean> {
  try {
    await action();
    return true;
  } catch (error) {
    toast(errorText(error), { tone: "problem" });
    return false;
  }
}
