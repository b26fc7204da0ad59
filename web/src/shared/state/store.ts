/** State of the service: from REST at the start and after every gap, from the WebSocket in between. */

import { create } from "zustand";

import * as calls from "../api/calls";
import { Events, type ConnectionState } from "../api/events";
import { ApiError, UnreachableError, onUnauthorized } from "../api/http";
import type { Capture, Device, Message, Preview, Reconstruction, SceneEvent, System } from "../api/types";
import { notifyOfEnd } from "./notifying";
import { poses } from "./poses";
import { route } from "./route";
import { FRONT, isBehind, isEnded, isFinished, tooMany, tooManyCaptures } from "./keptJobs";

const NEWEST = 20;
/** Polling interval of REST without a WebSocket. */
const POLL_MS = 2000;
const SYSTEM_MS = 10_000;
/** Interval at which messages are stored while the page is hidden. */
const HIDDEN_MS = 100;
/** Captures whose live pictures are kept. */
const PICTURED = 4;

export interface ServiceState {
  link: ConnectionState;
  /** Connection error; null while the service answers. */
  connectionError: string | null;
  /** A token is required: no requests until sign-in. */
  signedOut: boolean;
  loaded: boolean;
  /** How often everything was fetched again; what one page alone shows is fetched again with it. */
  refreshed: number;
  devices: Device[];
  /** Known captures by id, of the ended ones the last told of; the table of all captures asks for its own pages. */
  captures: Record<string, Capture>;
  /** Known reconstructions by id; of a long queue its front, and few behind it; the last ones that have ended. */
  reconstructions: Record<string, Reconstruction>;
  /** Length of the queue; while it is no longer than its front, the most that it was. */
  queued: number;
  system: System | null;
  /** Newest picture of each kind that came over the socket, by capture; of the last ones that sent some. */
  previews: Record<string, Record<string, Preview>>;
  /** Newest scene of each reconstruction. */
  scenes: Record<string, SceneEvent>;
  /** Frames a second, by capture, from the counters of those that run. */
  rates: Record<string, number>;
}

export const useService = create<ServiceState>(() => ({
  link: { state: "connecting" },
  connectionError: null,
  signedOut: false,
  loaded: false,
  refreshed: 0,
  devices: [],
  captures: {},
  reconstructions: {},
  queued: 0,
  system: null,
  previews: {},
  scenes: {},
  rates: {},
}));

const { setState: set, getState: get } = useService;

/** Whether the capture still takes frames; while it only refines, its device is free. */
export const isAcquiring = (capture: Capture): boolean => ["starting", "waiting", "streaming"].includes(capture.state);
export { isEnded, isFinished };

/** Ids are UUIDs of version 7: the largest is the newest. */
export function newestCapture(captures: Record<string, Capture>): Capture | null {
  let newest: Capture | null = null;
  for (const one of Object.values(captures))
    if (one.deleted_at === null && (newest === null || one.id > newest.id)) newest = one;
  return newest;
}

type Jobs = Record<string, Reconstruction>;
/** Many components ask this of the same jobs. */
const newestKnown = new WeakMap<Jobs, Map<string, Reconstruction>>();

/** The one whose scene is shown: one with a scene goes before a later one that has none yet. */
export const shownOf = (one: Reconstruction, other: Reconstruction): Reconstruction =>
  one.version > 0 === other.version > 0 ? (one.id > other.id ? one : other) : one.version > 0 ? one : other;

/** The newest reconstruction of a capture that is known; one with a scene goes before a later one that has none yet. */
export function newestReconstruction(jobs: Jobs, captureId: string | null): Reconstruction | null {
  let newest = newestKnown.get(jobs);
  if (newest === undefined) {
    newest = new Map<string, Reconstruction>();
    for (const job of Object.values(jobs)) {
      if (job.task === "localise") continue;
      const before = newest.get(job.capture_id);
      newest.set(job.capture_id, before === undefined ? job : shownOf(before, job));
    }
    newestKnown.set(jobs, newest);
  }
  return captureId === null ? null : (newest.get(captureId) ?? null);
}

/** Running reconstructions, then queued ones in order. */
export const activeJobs = (jobs: Record<string, Reconstruction>): Reconstruction[] =>
  Object.values(jobs)
    .filter((job) => !isEnded(job))
    .sort((a, b) => (a.queue_place ?? 0) - (b.queue_place ?? 0) || (a.id < b.id ? -1 : 1));

/** Captures whose frames are received, the oldest first. */
export const acquiringCaptures = (captures: Record<string, Capture>): Capture[] =>
  Object.values(captures)
    .filter((one) => one.deleted_at === null && isAcquiring(one))
    .sort((a, b) => (a.id < b.id ? -1 : 1));

const counted = new Map<string, { frames: number; atMs: number }>();

/** The rates with the acquisition rate of a capture, smoothed over about a second; without it while that is not known. */
function measuredRates(rates: Record<string, number>, capture: Capture): Record<string, number> {
  const frames = capture.counters?.next_frame;
  const before = counted.get(capture.id);
  if (frames === undefined || capture.state !== "streaming") {
    counted.delete(capture.id);
    return capture.id in rates ? without(rates, capture.id) : rates;
  }
  const now = performance.now();
  if (before === undefined || frames < before.frames) {
    counted.set(capture.id, { frames, atMs: now });
    return capture.id in rates ? without(rates, capture.id) : rates;
  }
  const elapsed = (now - before.atMs) / 1000;
  if (elapsed < 0.5) return rates;
  counted.set(capture.id, { frames, atMs: now });
  return { ...rates, [capture.id]: (frames - before.frames) / elapsed };
}

/**
 * A message, and the answer to a change, tell the newest state; an answer that was asked for before is older, and must
 * not replace it. `heard` has when each object was last told of, removed, or asked for, on a clock that counts these.
 */
let clock = 0;
const heard = new Map<string, number>();
const hear = (id: string): void => void heard.set(id, ++clock);
const isNewer = (id: string, asked: number): boolean => (heard.get(id) ?? 0) > asked;

/** `stored` with what a request made at `asked` has answered; of objects that it does not list, those that `kept` keeps. */
function merged<T extends { id: string }>(
  stored: Record<string, T>,
  answered: T[],
  asked: number,
  kept: (one: T) => boolean,
): Record<string, T> {
  const listed = new Set(answered.map((one) => one.id));
  const newest = answered.filter((one) => !isNewer(one.id, asked));
  for (const one of newest) heard.set(one.id, asked);
  return Object.fromEntries([
    ...Object.values(stored)
      .filter((one) => isNewer(one.id, asked) || (!listed.has(one.id) && kept(one)))
      .map((one) => [one.id, one] as const),
    ...newest.map((one) => [one.id, one] as const),
  ]);
}

/** Without the ended captures that are too many: those told of first; never the newest, nor the one in the address. */
function withoutManyCaptures(captures: Record<string, Capture>): Record<string, Capture> {
  let spared: (string | null | undefined)[] | undefined;
  const forgotten = tooManyCaptures(captures, ({ id }) => {
    spared ??= [route().capture, newestCapture(captures)?.id];
    return spared.includes(id) ? Infinity : (heard.get(id) ?? 0);
  });
  if (forgotten.size === 0) return captures;
  for (const id of forgotten) heard.delete(id);
  return Object.fromEntries(Object.entries(captures).filter(([id]) => !forgotten.has(id)));
}

/** Store a capture that a message, or the answer to a change, tells of. */
export function storeCapture(capture: Capture): void {
  hear(capture.id);
  set((state) => ({
    captures: withoutManyCaptures({ ...state.captures, [capture.id]: capture }),
    rates: measuredRates(state.rates, capture),
  }));
}

/** Without those that are too many; those of the capture in the address go last, and those that it names never. */
function withoutMany(jobs: Jobs): Jobs {
  const { capture, reconstruction, against } = route();
  const forgotten = tooMany(jobs, (job) =>
    job.id === reconstruction || job.id === against
      ? Infinity
      : (heard.get(job.id) ?? 0) + (job.capture_id === capture ? clock : 0),
  );
  if (forgotten.size === 0) return jobs;
  for (const id of forgotten) heard.delete(id);
  return Object.fromEntries(Object.entries(jobs).filter(([id]) => !forgotten.has(id)));
}

/** Store a reconstruction that a message, or the answer to a change, tells of. */
export const storeReconstruction = (job: Reconstruction): void => storeReconstructions([job]);

function storeReconstructions(told: Reconstruction[]): void {
  const before = get().reconstructions;
  const newest = Object.fromEntries(told.map((job) => [job.id, job]));
  for (const id of Object.keys(newest)) hear(id);
  set((state) => ({
    reconstructions: withoutMany({ ...state.reconstructions, ...newest }),
    queued: Math.max(state.queued, ...told.map((job) => job.queue_place ?? 0)),
  }));
  for (const job of Object.values(newest)) notifyOfEnd(before[job.id], job);
}

const without = <T>(all: Record<string, T>, id: string): Record<string, T> =>
  Object.fromEntries(Object.entries(all).filter(([key]) => key !== id));

export function removeReconstruction(id: string): void {
  hear(id);
  set((state) => ({ reconstructions: without(state.reconstructions, id) }));
}

export function removeFromStore(id: string): void {
  hear(id);
  set((state) => ({ captures: without(state.captures, id) }));
}

/** Handle messages that came together; neighbours about jobs are one change, as places of a queue change. */
export function handleMessages(messages: Message[]): void {
  let jobs: Reconstruction[] = [];
  for (const message of messages) {
    if (message.topic === "job") {
      jobs.push(message.data);
      continue;
    }
    if (jobs.length > 0) storeReconstructions(jobs);
    jobs = [];
    handleMessage(message);
  }
  if (jobs.length > 0) storeReconstructions(jobs);
}

export function handleMessage(message: Message): void {
  switch (message.topic) {
    case "device": {
      const device = message.data;
      hear(device.id);
      set((state) => ({
        devices: state.devices.some((one) => one.id === device.id)
          ? state.devices.map((one) => (one.id === device.id ? device : one))
          : [...state.devices, device],
      }));
      return;
    }
    case "capture":
      storeCapture(message.data);
      return;
    case "job":
      storeReconstruction(message.data);
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
      if (message.capture_id !== null) {
        const id = message.capture_id;
        set(({ previews }) => {
          const others = Object.entries(without(previews, id)).slice(1 - PICTURED);
          const own = { ...previews[id], [message.data.kind]: message.data };
          return { previews: Object.fromEntries([...others, [id, own]]) };
        });
      }
      return;
    case "log":
    case "lost":
      return;
  }
}

/** With a capital and a full stop, unless it begins with a path or ends with a sign already. */
export const sentence = (text: string): string =>
  text.replace(/^[a-z](?=[a-z]* )/, (c) => c.toUpperCase()).replace(/([^.!?…])$/, "$1.");

/** Text of an error, for display. */
export function errorText(error: unknown): string {
  if (error instanceof ApiError) {
    if (error.status === 401) return "This service requires a token.";
    // `what_to_do` of these is meant for API clients.
    if (error.status === 404 && error.message.startsWith("there is no "))
      return `${sentence(error.message.split(";")[0] ?? "")} It may have been deleted.`;
    return error.whatToDo === null || error.status === 422
      ? sentence(error.message)
      : `${sentence(error.message)} ${sentence(error.whatToDo)}`;
  }
  if (error instanceof UnreachableError) return error.message;
  return error instanceof Error ? error.message : String(error);
}

/** Fetch everything shown on more than one page. */
export async function refresh(): Promise<void> {
  const asked = ++clock;
  try {
    const [devices, captures, unfinished] = await Promise.all([
      calls.devices(),
      calls.captures({ limit: NEWEST }),
      calls.unfinished(FRONT),
    ]);
    // Those far behind in the queue have not begun since; the page of their capture asks for them again.
    const active = activeJobs(get().reconstructions).filter((job) => !isBehind(job));
    // The list ends there: what is older, or removed, is not in it.
    const oldest = captures.next_cursor === null ? "" : (captures.items.at(-1)?.id ?? "");
    set((state) => ({
      devices: devices.map((one) => (isNewer(one.id, asked) && state.devices.find(({ id }) => id === one.id)) || one),
      captures: merged(state.captures, captures.items, asked, (one) => one.id < oldest || one.deleted_at !== null),
      reconstructions: merged(state.reconstructions, unfinished.jobs, asked, isEnded),
      queued: unfinished.queued,
      loaded: true,
      refreshed: state.refreshed + 1,
      connectionError: null,
    }));
    const missed = active.filter((job) => get().reconstructions[job.id] === undefined);
    const newest = newestCapture(get().captures);
    if (newest !== null) await loadReconstructions(newest.id);
    for (const job of missed) await tellEnd(job);
  } catch (error) {
    set({ connectionError: errorText(error) });
  }
}

/** Tell the end of a job that was under way, is no longer listed as such, and whose messages were missed. */
async function tellEnd(before: Reconstruction): Promise<void> {
  // An error: it was deleted meanwhile, or the service is out of reach again.
  if (get().reconstructions[before.id] === undefined) await loadReconstruction(before.id).catch(() => undefined);
  const now = get().reconstructions[before.id];
  if (now !== undefined) notifyOfEnd(before, now);
}

export async function loadCapture(id: string): Promise<void> {
  const asked = ++clock;
  const one = await calls.capture(id);
  set((state) => ({ captures: withoutManyCaptures(merged(state.captures, [one], asked, () => true)) }));
}

async function mergeReconstructions(ask: () => Promise<Reconstruction[]>): Promise<void> {
  const asked = ++clock;
  const jobs = await ask();
  set((state) => ({ reconstructions: withoutMany(merged(state.reconstructions, jobs, asked, () => true)) }));
}

export const loadReconstruction = (id: string): Promise<void> =>
  mergeReconstructions(async () => [await calls.reconstruction(id)]);
export const loadReconstructions = (captureId: string, before: string | null = null): Promise<void> =>
  mergeReconstructions(() => calls.reconstructions(captureId, before));
/** The complete ones of all captures. */
export const loadComplete = (): Promise<void> => mergeReconstructions(calls.complete);

async function refreshSystem(): Promise<void> {
  try {
    set({ system: await calls.system(), connectionError: null });
    if (get().queued > FRONT) set({ queued: await calls.queueLength() });
  } catch (error) {
    set({ connectionError: errorText(error) });
  }
}

onUnauthorized(() => set({ signedOut: true }));
/** The scope may be another one: it is unknown until the service states it. */
export function signedIn(): void {
  const before = get().signedOut;
  set({ signedOut: false, connectionError: null, system: null });
  if (!before) void refreshSystem(); // else following begins anew
}

/** Passes messages on together, once a frame; in a hidden page, which draws none, ten times a second. */
function gathered(pass: (messages: Message[]) => void): (message: Message) => void {
  let waiting: Message[] = [];
  const flush = (): void => {
    const messages = waiting;
    waiting = [];
    pass(messages);
  };
  return (message) => {
    waiting.push(message);
    if (waiting.length > 1) return;
    if (document.hidden) setTimeout(flush, HIDDEN_MS);
    else requestAnimationFrame(flush);
  };
}

/** Start following the service; returns a function that stops it. */
export function follow(): () => void {
  const events = new Events({
    onMessage: gathered(handleMessages),
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
