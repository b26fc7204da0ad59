/** Where the page is, kept in the URL: a reload or a shared link shows the same thing. */

import { useSyncExternalStore } from "react";

export const PAGES = ["live", "scene", "captures", "setup"] as const;
export type PageName = (typeof PAGES)[number];

export interface Route {
  page: PageName;
  /** Capture looked at; the newest one if none is named. */
  capture: string | null;
  /** Reconstruction looked at; the newest of its capture if none is named. */
  reconstruction: string | null;
  /** Frame of the scrubber; null follows the newest. */
  frame: number | null;
  /** Seven numbers: position and target of the orbiting camera, and its field of view in degrees. */
  camera: number[] | null;
  /** Whether the scene is seen through the camera of the capture. */
  ride: boolean;
  /** What the captures table is searched for. */
  search: string;
}

export const HOME: Route = {
  page: "live",
  capture: null,
  reconstruction: null,
  frame: null,
  camera: null,
  ride: false,
  search: "",
};

/** Names in the URL are letters, digits and dashes: what else comes from a link is not passed on. */
const identifier = (text: string | null): string | null => (text !== null && /^[\w-]{1,64}$/.test(text) ? text : null);

export function parseRoute(search: string): Route {
  const asked = new URLSearchParams(search);
  const page = PAGES.find((name) => name === asked.get("page")) ?? "live";
  const frame = asked.get("frame");
  const camera = asked.get("camera")?.split(",").map(Number);
  return {
    page,
    capture: identifier(asked.get("capture")),
    reconstruction: identifier(asked.get("reconstruction")),
    frame: frame !== null && /^\d{1,15}$/.test(frame) ? Number(frame) : null,
    camera: camera?.length === 7 && camera.every(Number.isFinite) ? camera : null,
    ride: asked.get("ride") === "1",
    search: asked.get("search") ?? "",
  };
}

export function formatRoute(route: Route): string {
  const pairs = new URLSearchParams();
  if (route.page !== "live") pairs.set("page", route.page);
  if (route.capture !== null) pairs.set("capture", route.capture);
  if (route.reconstruction !== null) pairs.set("reconstruction", route.reconstruction);
  if (route.frame !== null) pairs.set("frame", String(route.frame));
  if (route.camera !== null) pairs.set("camera", route.camera.map((x) => Number(x.toPrecision(5))).join(","));
  if (route.ride) pairs.set("ride", "1");
  if (route.search !== "") pairs.set("search", route.search);
  const text = pairs.toString().replaceAll("%2C", ",");
  return text === "" ? "./" : `./?${text}`;
}

let current = parseRoute(window.location.search);
const listeners = new Set<() => void>();
const subscribe = (listener: () => void): (() => void) => {
  listeners.add(listener);
  return () => listeners.delete(listener);
};

function set(route: Route, push: boolean): void {
  if (formatRoute(route) === formatRoute(current)) return;
  current = route;
  window.history[push ? "pushState" : "replaceState"](null, "", formatRoute(route));
  for (const listener of listeners) listener();
}

window.addEventListener("popstate", () => {
  current = parseRoute(window.location.search);
  for (const listener of listeners) listener();
});

/** Go somewhere: a new entry of the history. */
export const go = (change: Partial<Route>): void => set({ ...current, ...change }, true);
/** Change details of where the page is, without a new entry. */
export const adjust = (change: Partial<Route>): void => set({ ...current, ...change }, false);
export const route = (): Route => current;
export const useRoute = (): Route => useSyncExternalStore(subscribe, route);

/** A token in the address would end up in screenshots and bookmarks: the service has set its cookie, it can go. */
export function dropToken(): void {
  if (new URLSearchParams(window.location.search).has("token"))
    window.history.replaceState(null, "", formatRoute(current));
}
