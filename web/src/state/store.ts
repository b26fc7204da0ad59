/** What is known of the service, from REST at the start and after every gap, from the WebSocket in between. */

import { create } from "zustand";

import * as calls from "../api/calls";
import { Events, type Link } from "../api/events";
import { ApiError, UnreachableError, whenRefused } from "../api/http";
import type { Capture, Device, Message, Preview, Reconstruction, SceneNews, System } from "../api/types";
import { poses } from "./poses";

const NEWEST = 20;
/** While the socket is away, REST is asked this often. */
const POLL_MS = 2000;
const SYSTEM_MS = 10_000;

export interface ServiceState {
  link: Link;
  /** Why the service could not be asked; null while it answers. */
  trouble: string | null;
  /** The service wants a token that this page has not: nothing is asked for until somebody signs in. */
  signedOut: boolean;
  loaded: boolean;
  devices: Device[];
  /** Known captures by id; the table of all captures asks for its own pages. */
  captures: Record<string, Capture>;
  reconstructions: Record<string, Reconstruction>;
  system: System | null;
  /** Newest picture of each kind that came over the socket. */
  previews: Record<string, Preview>;
  /** Capture that `previews` show. */
  previewOf: string | null;
  /** Newest scene of each reconstruction. */
  scenes: Record<string, SceneNews>;
  /** Frames a second, from the counters of the capture that runs. */
  rateHz: number | null;
}

export const useService = create<ServiceState>(() => ({
  link: { state: "connecting" },
  trouble: null,
  signedOut: false,
  loaded: false,
  devices: [],
  captures: {},
  reconstructions: {},
  system: null,
  previews: {},
  previewOf: null,
  scenes: {},
  rateHz: null,
}));

const { setState: set, getState: get } = useService;

export const isOver = (capture: Capture): boolean => capture.state === "complete" || capture.state === "failed";
export const isEnded = (job: Reconstruction): boolean => !["queued", "running"].includes(job.state);

/** Ids are UUIDs of version 7: the largest is the newest. */
export function newestCapture(captures: Record<string, Capture>): Capture | null {
  let newest: Capture | null = null;
  for (const one of Object.values(captures))
    if (one.deleted_at === null && (newest === null || one.id > newest.id)) newest = one;
  return newest;
}

/** The newest reconstruction of a capture; one with a scene goes before a later one that has none yet. */
export function newestReconstruction(
  jobs: Record<string, Reconstruction>,
  captureId: string | null,
): Reconstruction | null {
  const own = Object.values(jobs)
    .filter((job) => job.capture_id === captureId)
    .sort((a, b) => (a.id < b.id ? 1 : -1));
  return own.find((job) => job.version > 0) ?? own[0] ?? null;
}

let counted: { id: string; frames: number; atMs: number } | null = null;

/** The acquisition rate, smoothed over about a second. */
function measureRate(capture: Capture): number | null {
  const frames = capture.counters?.next_frame;
  if (frames === undefined || capture.state !== "streaming") {
    counted = null;
    return null;
  }
  const now = performance.now();
  if (counted === null || counted.id !== capture.id || frames < counted.frames) {
    counted = { id: capture.id, frames, atMs: now };
    return null;
  }
  const elapsed = (now - counted.atMs) / 1000;
  if (elapsed < 0.5) return get().rateHz;
  const rate = (frames - counted.frames) / elapsed;
  counted = { id: capture.id, frames, atMs: now };
  return rate;
}

export function takeCapture(capture: Capture): void {
  set((state) => ({
    captures: { ...state.captures, [capture.id]: capture },
    rateHz:
      newestCapture({ ...state.captures, [capture.id]: capture })?.id === capture.id
        ? measureRate(capture)
        : state.rateHz,
  }));
}

export function takeReconstruction(job: Reconstruction): void {
  set((state) => ({ reconstructions: { ...state.reconstructions, [job.id]: job } }));
}

export function forgetCapture(id: string): void {
  set((state) => ({ captures: Object.fromEntries(Object.entries(state.captures).filter(([key]) => key !== id)) }));
}

export function takeMessage(message: Message): void {
  switch (message.topic) {
    case "device": {
      const device = message.data;
      set((state) => ({
        devices: state.devices.some((one) => one.id === device.id)
          ? state.devices.map((one) => (one.id === device.id ? device : one))
          : [...state.devices, device],
      }));
      return;
    }
    case "capture":
      takeCapture(message.data);
      return;
    case "job":
      takeReconstruction(message.data);
      return;
    case "pose":
      poses.push(message.capture_id, message.data);
      return;
    case "scene":
      if (message.reconstruction_id !== null) {
        const id = message.reconstruction_id;
        set((state) => ({ scenes: { ...state.scenes, [id]: message.data } }));
      }
      return;
    case "preview":
      set((state) => ({
        previews: {
          ...(state.previewOf === message.capture_id ? state.previews : {}),
          [message.data.kind]: message.data,
        },
        previewOf: message.capture_id,
      }));
      return;
    case "log":
    case "lost":
      return;
  }
}

/** With a capital and a full stop, unless it begins with a path or ends with a sign already. */
export const sentence = (text: string): string =>
  text.replace(/^[a-z](?=[a-z]* )/, (c) => c.toUpperCase()).replace(/([^.!?…])$/, "$1.");

/** Why asking failed, in words for a person. */
export function wordsOf(error: unknown): string {
  if (error instanceof ApiError) {
    if (error.status === 401) return "This service needs its token.";
    // What the service advises then is written for callers of its API.
    if (error.status === 404 && error.message.startsWith("there is no "))
      return `${sentence(error.message.split(";")[0] ?? "")} It may have been deleted.`;
    return error.whatToDo === null ? sentence(error.message) : `${sentence(error.message)} ${sentence(error.whatToDo)}`;
  }
  if (error instanceof UnreachableError) return error.message;
  return error instanceof Error ? error.message : String(error);
}

/** Ask for everything that is shown on more than one page. */
export async function refresh(): Promise<void> {
  try {
    const [devices, captures] = await Promise.all([calls.devices(), calls.captures({ limit: NEWEST })]);
    const known = Object.fromEntries(captures.items.map((one) => [one.id, one]));
    set({ devices, captures: known, loaded: true, trouble: null });
    const newest = newestCapture(known);
    if (newest !== null) {
      takeCapture(newest);
      await loadReconstructions(newest.id);
    }
  } catch (error) {
    set({ trouble: wordsOf(error) });
  }
}

export async function loadReconstructions(captureId: string): Promise<void> {
  const jobs = await calls.reconstructions(captureId);
  set((state) => ({
    reconstructions: { ...state.reconstructions, ...Object.fromEntries(jobs.map((job) => [job.id, job])) },
  }));
}

async function refreshSystem(): Promise<void> {
  try {
    set({ system: await calls.system(), trouble: null });
  } catch (error) {
    set({ trouble: wordsOf(error) });
  }
}

whenRefused(() => set({ signedOut: true }));
export const signedIn = (): void => set({ signedOut: false, trouble: null });

/** Begin to follow the service; the function returned ends it. */
export function follow(): () => void {
  const events = new Events({
    onMessage: takeMessage,
    onLink: (link) => {
      const before = get().link.state;
      set({ link });
      if (link.state === "open" && before !== "open") {
        void refresh();
        void refreshSystem();
      }
    },
    onGap: () => void refresh(),
  });
  void refresh();
  void refreshSystem();
  events.open();
  const polling = setInterval(() => {
    if (get().link.state !== "open" && !document.hidden) void refresh();
  }, POLL_MS);
  const system = setInterval(() => {
    if (!document.hidden) void refreshSystem();
  }, SYSTEM_MS);
  return () => {
    clearInterval(polling);
    clearInterval(system);
    events.close();
  };
}
