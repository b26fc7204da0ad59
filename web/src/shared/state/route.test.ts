import { beforeEach, expect, it, vi } from "vitest";

import { adjust, dropToken, formatRoute, go, HOME, linkTo, nameFound, parseRoute, route } from "./route";

beforeEach(() => {
  nameFound(null, null);
  go(HOME);
});

it("keeps everything that is looked at in the URL", () => {
  const there = {
    page: "scene" as const,
    capture: "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10",
    reconstruction: "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e11",
    version: 7,
    frame: 640,
    camera: [0.5, 1, -2, 0, 0, -1, 55],
    ride: true,
    show: "depth",
    hide: "grid,axes",
    by: "speed",
    against: "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e12",
    againstVersion: 3,
    how: "wipe",
    search: "desk & lamp",
    filter: "kept",
    sort: "size",
    ascending: true,
  };
  expect(parseRoute(formatRoute(there).slice(2))).toEqual(there);
});

it("does not believe what a link says", () => {
  const odd = parseRoute("?page=attic&hide=1,*&capture=../../etc&frame=-1&camera=1,2,x,4,5,6,7&reconstruction=a%2Fb");
  expect(odd).toEqual(HOME);
});

it("takes details into the same entry of the history and pages into a new one", () => {
  const before = window.history.length;
  adjust({ frame: 3 });
  expect(window.history.length).toBe(before);
  go({ page: "scene" });
  expect(window.history.length).toBe(before + 1);
  expect(window.location.search).toBe("?page=scene&frame=3");
});

it("lets go of a version and a comparison with their reconstruction", () => {
  go({ page: "scene", reconstruction: "a", version: 3, against: "c" });
  go({ page: "captures" });
  expect(route().version).toBe(3);
  go({ page: "scene", reconstruction: "b" });
  expect(route().version).toBeNull();
  expect(route().against).toBeNull();
});

it("lets go of a version when the capture changes without a new entry, too", () => {
  go({ page: "scene", capture: "x", reconstruction: "a", version: 3, camera: [1, 2, 3, 4, 5, 6, 7] });
  adjust({ capture: null });
  expect(route()).toMatchObject({ page: "scene", reconstruction: null, version: null, camera: null });
  go({ capture: "y", reconstruction: "b", frame: 7 });
  expect(route()).toMatchObject({ capture: "y", reconstruction: "b", frame: 7 });
  adjust({ capture: "y", frame: 8 });
  expect(route().reconstruction).toBe("b");
});

it("names what the Scene page shows in the address, and goes on following the newest", () => {
  go({ page: "scene", frame: 7 });
  nameFound("x", "a");
  expect(window.location.search).toBe("?page=scene&capture=x&reconstruction=a&frame=7");
  expect(route()).toMatchObject({ capture: null, reconstruction: null, frame: 7 });
  nameFound("y", "b");
  expect(window.location.search).toContain("capture=y&reconstruction=b");
  expect(linkTo({ version: 3 })).toBe("http://localhost:3000/?page=scene&capture=y&reconstruction=b&version=3");
  go({ page: "live" });
  expect(window.location.search).toBe("");
  expect(linkTo({})).not.toContain("capture");
});

it("follows after a reload and a step back what it followed, but not where a link is opened", async () => {
  go({ page: "scene" });
  nameFound("x", "a");
  vi.resetModules();
  const reloaded = await import("./route");
  expect(reloaded.route()).toMatchObject({ page: "scene", capture: null, reconstruction: null });
  window.history.replaceState(null, "", window.location.href);
  vi.resetModules();
  const opened = await import("./route");
  expect(opened.route()).toMatchObject({ page: "scene", capture: "x", reconstruction: "a" });
});

it("names after a step back what is shown, not what was found when the entry was left", () => {
  go({ page: "scene" });
  nameFound("x", "a");
  const left = { state: window.history.state as unknown, url: window.location.href };
  go({ capture: "y", reconstruction: "b" });
  nameFound("y", "b"); // and y/b is the newest by now
  window.history.replaceState(left.state, "", left.url);
  window.dispatchEvent(new PopStateEvent("popstate"));
  nameFound("y", "b");
  expect(route()).toMatchObject({ capture: null, reconstruction: null });
  expect(window.location.search).toBe("?page=scene&capture=y&reconstruction=b");
});

it("keeps nothing of a reconstruction when another one is followed, also after a visit elsewhere or a reload", async () => {
  go({ page: "scene" });
  nameFound("x", "a");
  const details = { version: 3, frame: 7, camera: [1, 2, 3, 4, 5, 6, 7], against: "c" };
  const none = { version: null, frame: null, camera: null, against: null };
  adjust(details);
  go({ page: "live" });
  nameFound(null, null);
  go({ page: "scene" });
  nameFound("x", "a");
  expect(route()).toMatchObject(details);
  go({ page: "live" });
  nameFound(null, null);
  go({ page: "scene" });
  nameFound("y", "b");
  expect(route()).toMatchObject(none);
  expect(window.location.search).toBe("?page=scene&capture=y&reconstruction=b");
  go({ page: "live" });
  go({ page: "scene", ...details });
  vi.resetModules();
  const reloaded = await import("./route");
  reloaded.nameFound("z", "d");
  expect(reloaded.route()).toMatchObject(none);
});

it("keeps the view when what is followed becomes chosen", () => {
  go({ page: "scene" });
  nameFound("x", "a");
  adjust({ frame: 7 });
  adjust({ capture: "x", reconstruction: "a", version: 3 });
  expect(route()).toMatchObject({ capture: "x", reconstruction: "a", version: 3, frame: 7 });
  nameFound("x", "a");
  expect(route().version).toBe(3);
});

it("plays through more frames than a browser allows changes of the address", () => {
  vi.useFakeTimers();
  const real = window.history.replaceState.bind(window.history);
  let calls = 0;
  const spy = vi.spyOn(window.history, "replaceState").mockImplementation((...all) => {
    calls += 1;
    if (calls > 100) throw new DOMException("too many", "SecurityError");
    real(...all);
  });
  for (let frame = 1; frame <= 600; frame += 1) {
    adjust({ frame });
    expect(route().frame).toBe(frame);
    vi.advanceTimersByTime(16);
  }
  vi.advanceTimersByTime(1000);
  expect(calls).toBeLessThan(50);
  expect(window.location.search).toContain("frame=600");
  spy.mockRestore();
  vi.useRealTimers();
});

it("takes the token out of the address", () => {
  window.history.replaceState(null, "", "./?token=sesame");
  dropToken();
  expect(window.location.search).toBe("");
  expect(route().page).toBe("live");
});
