/** The state of the page in the URL: a reload or a shared link shows the same view. */

import { useSyncExternalStore } from "react";

export const PAGES = ["live", "scene", "captures", "setup"] as const;
export type PageName = (typeof PAGES)[number];

export interface Route {
  page: PageName;
  /** Capture shown; null: the newest. */
  capture: string | null;
  /** Reconstruction shown; null: the newest of the capture. */
  reconstruction: string | null;
  /** Version of the scene; null follows the newest. */
  version: number | null;
  /** Frame of the scrubber; null follows the newest. */
  frame: number | null;
  /** Seven numbers: position and target of the orbiting camera, and its field of view in degrees. */
  camera: number[] | null;
  /** Whether the scene is shown from the camera of the capture. */
  ride: boolean;
  /** What the splats show. */
  show: string;
  /** Layers of the scene that are not drawn, separated by commas. */
  hide: string;
  /** What the path is coloured by; empty: the state of the tracking. */
  by: string;
  /** Reconstruction that the scene is compared with; null: none. */
  against: string | null;
  /** Its version; null follows the newest. */
  againstVersion: number | null;
  /** How they are compared, or, along the ride, the picture of the camera with the scene. */
  how: string;
  /** Search text of the captures table. */
  search: string;
  /** Which captures the table lists; empty: all that are not deleted. */
  filter: string;
  /** What the table is sorted by; empty: the time of the start. */
  sort: string;
  /** Whether it begins with the least: the oldest, smallest or first. */
  ascending: boolean;
}

export const HOME: Route = {
  page: "live",
  capture: null,
  reconstruction: null,
  version: null,
  frame: null,
  camera: null,
  ride: false,
  show: "",
  hide: "",
  by: "",
  against: null,
  againstVersion: null,
  how: "",
  search: "",
  filter: "",
  sort: "",
  ascending: false,
};

/** Identifiers are letters, digits and dashes; anything else in a link is ignored. */
const identifier = (text: string | null): string | null => (text !== null && /^[\w-]{1,64}$/.test(text) ? text : null);

const counted = (text: string | null): number | null =>
  text !== null && /^\d{1,15}$/.test(text) ? Number(text) : null;

const word = (text: string | null): string => /^[a-z]{1,16}$/.exec(text ?? "")?.[0] ?? "";

const words = (text: string | null): string => (text ?? "").split(",").map(word).filter(Boolean).join(",");

export function parseRoute(search: string): Route {
  const query = new URLSearchParams(search);
  const page = PAGES.find((name) => name === query.get("page")) ?? "live";
  const camera = query.get("camera")?.split(",").map(Number);
  return {
    page,
    capture: identifier(query.get("capture")),
    reconstruction: identifier(query.get("reconstruction")),
    version: counted(query.get("version")),
    frame: counted(query.get("frame")),
    camera: camera?.length === 7 && camera.every(Number.isFinite) ? camera : null,
    ride: query.get("ride") === "1",
    show: word(query.get("show")),
    hide: words(query.get("hide")),
    by: word(query.get("by")),
    against: identifier(query.get("against")),
    againstVersion: counted(query.get("against-version")),
    how: word(query.get("how")),
    search: query.get("search") ?? "",
    filter: word(query.get("filter")),
    sort: word(query.get("sort")),
    ascending: query.get("ascending") === "1",
  };
}

export function formatRoute(route: Route): string {
  const pairs = new URLSearchParams();
  if (route.page !== "live") pairs.set("page", route.page);
  if (route.capture !== null) pairs.set("capture", route.capture);
  if (route.reconstruction !== null) pairs.set("reconstruction", route.reconstruction);
  if (route.version !== null) pairs.set("version", String(route.version));
  if (route.frame !== null) pairs.set("frame", String(route.frame));
  if (route.camera !== null) pairs.set("camera", route.camera.map((x) => Number(x.toPrecision(5))).join(","));
  if (route.ride) pairs.set("ride", "1");
  if (route.show !== "") pairs.set("show", route.show);
  if (route.hide !== "") pairs.set("hide", route.hide);
  if (route.by !== "") pairs.set("by", route.by);
  if (route.against !== null) pairs.set("against", route.against);
  if (route.againstVersion !== null) pairs.set("against-version", String(route.againstVersion));
  if (route.how !== "") pairs.set("how", route.how);
  if (route.search !== "") pairs.set("search", route.search);
  if (route.filter !== "") pairs.set("filter", route.filter);
  if (route.sort !== "") pairs.set("sort", route.sort);
  if (route.ascending) pairs.set("ascending", "1");
  const text = pairs.toString().replaceAll("%2C", ",");
  return text === "" ? "./" : `./?${text}`;
}

/** The capture and the reconstruction, as chosen: of an entry of the history whose address names what was found instead. */
type Chosen = Pick<Route, "capture" | "reconstruction">;

/** What the address names; set when it is read or written. */
let addressed: Chosen = { capture: null, reconstruction: null };

/** The reconstruction that version, camera and the like of `current` belong to; null: the one that is found next. */
let belongsTo: string | null = null;

/** The state of an address: of an own entry of the history, reloads included, it follows what it followed. */
function restored(): Route {
  const route = parseRoute(window.location.search);
  const state = window.history.state as { chosen?: Partial<Chosen> } | null;
  addressed = route;
  belongsTo = state?.chosen === undefined ? null : route.reconstruction;
  if (state?.chosen === undefined) return route;
  const { capture, reconstruction } = state.chosen;
  return { ...route, capture: identifier(capture ?? null), reconstruction: identifier(reconstruction ?? null) };
}

/** What the Scene page has found where nothing is chosen. */
let found: Chosen = { capture: null, reconstruction: null };

/** The route with what is seen where it follows the newest: for addresses, which others shall see the same by. */
const named = (route: Route): Route =>
  route.page === "scene"
    ? {
        ...route,
        capture: route.capture ?? found.capture,
        reconstruction: route.reconstruction ?? found.reconstruction,
      }
    : route;

let current = restored();
const same = (a: Chosen, b: Chosen): boolean => a.capture === b.capture && a.reconstruction === b.reconstruction;
const listeners = new Set<() => void>();
const subscribe = (listener: () => void): (() => void) => {
  listeners.add(listener);
  return () => listeners.delete(listener);
};

/** Browsers refuse more than some ten changes of the address a second, and a played path has sixty. */
const ADDRESS_MS = 400;
let writtenMs = -Infinity;
let pending: ReturnType<typeof setTimeout> | undefined;

function set(route: Route, push: boolean): void {
  if (formatRoute(route) === formatRoute(current)) return;
  if (push) flush(); // the entry that is left shows what was seen last
  if (!same(route, current)) belongsTo = null;
  current = route;
  for (const listener of listeners) listener();
  const waitMs = push ? 0 : writtenMs + ADDRESS_MS - performance.now();
  if (waitMs <= 0) writeAddress(push ? "pushState" : "replaceState");
  else pending ??= setTimeout(writeAddress, waitMs);
}

function writeAddress(how: "pushState" | "replaceState" = "replaceState"): void {
  clearTimeout(pending);
  pending = undefined;
  writtenMs = performance.now();
  try {
    const { capture, reconstruction } = current;
    const written = named(current);
    window.history[how]({ chosen: { capture, reconstruction } }, "", formatRoute(written));
    addressed = written;
  } catch {
    pending = setTimeout(writeAddress, 10 * ADDRESS_MS); // refused: the limit counts other parts of the page, too
  }
}

function flush(): void {
  if (pending !== undefined) writeAddress();
}
window.addEventListener("pagehide", flush);

window.addEventListener("popstate", () => {
  clearTimeout(pending);
  pending = undefined;
  current = restored();
  for (const listener of listeners) listener();
});

/** What belongs to one reconstruction. */
const OF_ONE: Partial<Route> = {
  version: null,
  against: null,
  againstVersion: null,
  how: "",
  camera: null,
  frame: null,
  ride: false,
};

/**
 * The route after a change; what belongs to one reconstruction is reset when another one, or another capture, is shown. To
 * choose what is found already shows no other.
 */
function changed(change: Partial<Route>): Route {
  const other = (key: keyof Chosen): boolean => key in change && change[key] !== current[key];
  const leaves = (key: keyof Chosen): boolean =>
    other(key) && (change[key] === null || current[key] !== null || change[key] !== found[key]);
  const reset = leaves("capture") || leaves("reconstruction") ? OF_ONE : {};
  return { ...current, ...reset, ...(other("capture") ? { reconstruction: null } : {}), ...change };
}

/** Navigate, with a new history entry. */
export const go = (change: Partial<Route>): void => set(changed(change), true);
/** Change parameters without a new history entry. */
export const adjust = (change: Partial<Route>): void => set(changed(change), false);
export const route = (): Route => current;
export const useRoute = (): Route => useSyncExternalStore(subscribe, route);

/**
 * Name in the address what the Scene page has found, so that a copied one shows it later, too. Nothing is chosen by that:
 * this page goes on following the newest, and so does the Live page. What belongs to the reconstruction that was followed
 * before is reset.
 */
export function nameFound(capture: string | null, reconstruction: string | null): void {
  found = { capture, reconstruction };
  if (current.page !== "scene" || capture === null) return;
  if (current.reconstruction === null && belongsTo !== null && belongsTo !== reconstruction) {
    current = { ...current, ...OF_ONE };
    for (const listener of listeners) listener();
  }
  belongsTo = reconstruction;
  if (!same(named(current), addressed)) writeAddress();
}

/** The whole address of what is seen, for others; `fixed` is as it is given. */
export const linkTo = (fixed: Partial<Route>): string =>
  new URL(formatRoute({ ...named(current), ...fixed }), document.baseURI).href;

/** Remove the token from the address, so that it is not in screenshots and bookmarks; the service has set its cookie. */
export function dropToken(): void {
  if (new URLSearchParams(window.location.search).has("token"))
    window.history.replaceState(window.history.state, "", formatRoute(named(current)));
}
