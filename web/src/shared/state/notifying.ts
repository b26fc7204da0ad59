/** Notifications at the end of reconstructions: off by default, remembered by this browser, without a sound. */

import { create } from "zustand";

import type { Reconstruction } from "../api/types";
import { toast } from "./toasts";

const KEY = "spiked.notify";

const remembered = (): boolean => {
  try {
    return localStorage.getItem(KEY) === "1" && "Notification" in window && Notification.permission === "granted";
  } catch {
    return false; // storage is forbidden
  }
};

const useStored = create<{ on: boolean }>(() => ({ on: remembered() }));
export const useNotifying = (): boolean => useStored((state) => state.on);

/** Turn notifications on or off; the browser asks once. */
export async function setNotifying(on: boolean): Promise<void> {
  const allowed = on && "Notification" in window && (await Notification.requestPermission()) === "granted";
  if (on && !allowed) toast("This browser does not allow notifications of this page.", { tone: "problem" });
  useStored.setState({ on: allowed });
  try {
    localStorage.setItem(KEY, allowed ? "1" : "0");
  } catch {
    // not remembered then
  }
}

/** Let the browser say that a reconstruction has ended, if that is turned on and the page is not in sight. */
export function notifyOfEnd(before: Reconstruction | undefined, job: Reconstruction): void {
  if (!useStored.getState().on || !document.hidden) return;
  if (before?.state !== "running" && before?.state !== "queued") return;
  if (job.state !== "complete" && job.state !== "failed") return;
  const text =
    job.state === "complete" ? "A reconstruction is complete." : `A reconstruction has failed: ${job.reason}`;
  try {
    new Notification("spiked", { body: text, silent: true });
  } catch {
    // Chrome on Android has the class, but lets only service workers use it.
    useStored.setState({ on: false });
    toast("This browser does not allow notifications of this page.", { tone: "problem" });
  }
}
