import { beforeEach, expect, it, vi } from "vitest";

import * as calls from "../api/calls";
import type { Capture, Message, Reconstruction } from "../api/types";
import { ApiError } from "../api/http";
import { progressText } from "./capture";
import { ENDED, FINISHED } from "./keptJobs";
import * as notifying from "./notifying";
import { poses } from "./poses";
import { adjust } from "./route";
import {
  isAcquiring,
  newestCapture,
  newestReconstruction,
  handleMessage,
  handleMessages,
  loadCapture,
  refresh,
  storeCapture,
  activeJobs,
  useService,
  errorText,
} from "./store";

const initial = useService.getInitialState();
beforeEach(() => useService.setState(initial, true));

const capture = (id: string, more: Partial<Capture> = {}): Capture =>
  ({ id, state: "streaming", deleted_at: null, counters: null, ...more }) as Capture;
const job = (id: string, captureId: string, version: number): Reconstruction =>
  ({ id, capture_id: captureId, version }) as Reconstruction;
const message = (topic: string, data: unknown, ids: Partial<Message> = {}): Message =>
  ({ seq: 1, topic, at: "", capture_id: null, reconstruction_id: null, data, ...ids }) as Message;

it("shows the newest capture that is not deleted", () => {
  const captures = { a: capture("a"), b: capture("b"), c: capture("c", { deleted_at: "2026-11-21T00:00:00Z" }) };
  expect(newestCapture(captures)?.id).toBe("b");
});

it("shows the newest reconstruction that has a scene, and one without only if there is no other", () => {
  const jobs = { x: job("x", "a", 3), y: job("y", "a", 0), z: job("z", "b", 9) };
  expect(newestReconstruction(jobs, "a")?.id).toBe("x");
  expect(newestReconstruction({ y: jobs.y }, "a")?.id).toBe("y");
  expect(newestReconstruction(jobs, "c")).toBeNull();
});

const pending = <T>(): { promise: Promise<T>; resolve: (value: T) => void } => {
  let resolve: (value: T) => void = () => undefined;
  const promise = new Promise<T>((done) => (resolve = done));
  return { promise, resolve };
};

it("keeps older and removed captures, and what messages told meanwhile, when it fetches again", async () => {
  const page = pending<Awaited<ReturnType<typeof calls.captures>>>();
  const open = pending<Awaited<ReturnType<typeof calls.unfinished>>>();
  vi.spyOn(calls, "devices").mockResolvedValue([]);
  vi.spyOn(calls, "captures").mockReturnValue(page.promise);
  vi.spyOn(calls, "unfinished").mockReturnValue(open.promise);
  vi.spyOn(calls, "reconstructions").mockImplementation((id) =>
    Promise.resolve([{ ...job("w", id, 1), state: "complete" }]),
  );
  const told = vi.spyOn(notifying, "notifyOfEnd").mockReturnValue();
  vi.spyOn(calls, "reconstruction").mockImplementation((id) =>
    Promise.resolve({ ...job(id, "e", 1), state: "failed" } as Reconstruction),
  );
  const removed = capture("d", { deleted_at: "2026-11-21T00:00:00Z" });
  const [ends, fails, newest] = [job("x", "e", 1), job("y", "e", 1), job("w", "f", 1)];
  useService.setState({
    captures: { a: capture("a"), d: removed, c: capture("c"), e: capture("e") },
    reconstructions: {
      x: { ...ends, state: "running" },
      y: { ...fails, state: "running" },
      w: { ...newest, state: "running" },
    },
  });
  const again = refresh();
  handleMessage(message("job", { ...ends, state: "complete" }));
  handleMessage(message("job", { ...job("z", "e", 0), state: "queued" }));
  handleMessage(message("capture", capture("f")));
  page.resolve({ items: [capture("e", { state: "complete" }), capture("b")], next_cursor: "more", total: 9 });
  open.resolve({ jobs: [{ ...ends, state: "running" }], queued: 0 });
  await again;
  const { captures, reconstructions } = useService.getState();
  expect(Object.keys(captures).sort()).toEqual(["a", "b", "d", "e", "f"]); // c is not there any more
  expect(captures["e"]?.state).toBe("complete");
  expect(Object.values(reconstructions).map((one) => [one.id, one.state])).toEqual([
    ["x", "complete"],
    ["z", "queued"],
    ["w", "complete"], // their messages were missed
    ["y", "failed"],
  ]);
  const ended = told.mock.calls.filter(([before, now]) => before?.state === "running" && now.state !== "running");
  expect(ended.map(([, now]) => now.id).sort()).toEqual(["w", "x", "y"]);
  vi.restoreAllMocks();
});

it("lets no answer replace what was told, or asked for, after it was asked for", async () => {
  const named = (name: string): Capture => capture("one", { name });
  const answers = [pending<Capture>(), pending<Capture>(), pending<Capture>()] as const;
  const ask = vi.spyOn(calls, "capture");
  for (const answer of answers) ask.mockReturnValueOnce(answer.promise);
  const name = (): string | undefined => useService.getState().captures["one"]?.name;

  const [older, newer] = [loadCapture("one"), loadCapture("one")];
  answers[1].resolve(named("newer"));
  await newer;
  answers[0].resolve(named("older"));
  await older;
  expect(name()).toBe("newer");

  const slow = loadCapture("one");
  storeCapture(named("by another"));
  answers[2].resolve(named("newer"));
  await slow;
  expect(name()).toBe("by another");
  vi.restoreAllMocks();
});

it("follows a device that comes and goes", () => {
  handleMessage(message("device", { id: "usb0", state: "idle" }));
  handleMessage(message("device", { id: "usb0", state: "lost" }));
  expect(useService.getState().devices).toEqual([{ id: "usb0", state: "lost" }]);
});

it("keeps pictures, poses and rates of cameras that run at the same time apart", () => {
  const picture = (id: string, image: string): void =>
    handleMessage(message("preview", { kind: "interval", image }, { capture_id: id }));
  for (const id of ["m", "n", "o", "a", "b"]) picture(id, id);
  picture("a", "newer");
  const { previews } = useService.getState();
  expect(previews["a"]?.["interval"]?.image).toBe("newer");
  expect(previews["b"]?.["interval"]?.image).toBe("b");
  expect(Object.keys(previews)).toEqual(["n", "o", "b", "a"]); // not of all captures of a long day

  for (const frame of [1, 2, 3]) {
    handleMessage(message("pose", { frame }, { capture_id: "a" }));
    handleMessage(message("pose", { frame: 10 * frame }, { capture_id: "b" }));
  }
  expect(poses.after("a", 1).map((one) => one.frame)).toEqual([2, 3]);
  expect(poses.newest("b")?.frame).toBe(30);

  const at = (next_frame: number): Capture["counters"] => ({ next_frame }) as Capture["counters"];
  const clock = vi.spyOn(performance, "now");
  [0, 1000, 2000].forEach((now, tick) => {
    clock.mockReturnValue(now);
    for (const [id, hz] of Object.entries({ a: 20_000, b: 400 }))
      storeCapture(capture(id, { state: "streaming", counters: at(hz * tick) }));
  });
  expect(useService.getState().rates).toEqual({ a: 20_000, b: 400 });
  storeCapture(capture("a", { state: "complete", counters: at(50_000) }));
  expect(useService.getState().rates).toEqual({ b: 400 });
  clock.mockRestore();
});

it("puts what the service says into sentences for a person", () => {
  const gone = new ApiError(
    404,
    "there is no capture 12; GET captures lists them",
    "look for the id with the GET of the list",
  );
  expect(errorText(gone)).toBe("There is no capture 12. It may have been deleted.");
  const full = new ApiError(507, "the disk is full", "remove recordings");
  expect(errorText(full)).toBe("The disk is full. Remove recordings.");
  expect(errorText(new ApiError(422, "/data/a.dat: cannot be read"))).toBe("/data/a.dat: cannot be read.");
  const refused = new ApiError(422, "no floor is seen", "correct the request; /docs describes its fields");
  expect(errorText(refused)).toBe("No floor is seen.");
});

it("lists those under way in the order of their turns, and says when each comes", () => {
  const at = (id: string, state: string, queue_place: number | null, eta_s: number | null): Reconstruction =>
    ({ id, capture_id: id, version: 0, state, queue_place, eta_s, progress: 0.4 }) as Reconstruction;
  const jobs = {
    c: at("c", "queued", 1, 90),
    b: at("b", "queued", 2, null),
    a: at("a", "running", null, 30),
    d: at("d", "complete", null, null),
  };
  expect(activeJobs(jobs).map((one) => [one.id, progressText(one)])).toEqual([
    ["a", "40\u202f%, about 30.0\u202fs left"],
    ["c", "place 1 in the queue, about 1\u202fmin 30\u202fs left"],
    ["b", "place 2 in the queue"],
  ]);
});

it("takes a camera as free while its last capture only refines", () => {
  const states = ["starting", "waiting", "streaming", "finishing", "complete"];
  expect(states.map((state) => isAcquiring({ state } as Capture))).toEqual([true, true, true, false, false]);
});

it("keeps the front of a long queue, and the few behind it that were told of last", async () => {
  const queued = (place: number, more: Partial<Reconstruction> = {}): void =>
    handleMessage(message("job", { ...job(`j${place}`, "a", 0), state: "queued", queue_place: place, ...more }));
  adjust({ capture: "shown" });
  queued(999, { id: "own", capture_id: "shown" });
  for (let place = 1; place <= 1000; place += 1) queued(place);
  queued(50, { queue_place: 1001, version: 2 }); // it has a scene, which may be in view
  const ids = (): string[] => Object.keys(useService.getState().reconstructions);
  expect(ids()).toHaveLength(200);
  expect(ids()).toEqual(expect.arrayContaining(["j1", "j50", "j100", "own", "j902", "j1000"]));
  expect(useService.getState().queued).toBe(1001);

  vi.spyOn(calls, "devices").mockResolvedValue([]);
  vi.spyOn(calls, "captures").mockResolvedValue({ items: [], next_cursor: null, total: 0 });
  vi.spyOn(calls, "unfinished").mockResolvedValue({
    jobs: [{ ...job("j1", "a", 0), state: "queued", queue_place: 1 }],
    queued: 1,
  });
  const asked = vi
    .spyOn(calls, "reconstruction")
    .mockImplementation((id) => Promise.resolve({ ...job(id, "a", 0), state: "cancelled" } as Reconstruction));
  await refresh();
  expect(asked).toHaveBeenCalledTimes(99); // of those that could have begun, the end is told
  expect(ids()).not.toContain("j1000");
  expect(useService.getState().queued).toBe(1);
  adjust({ capture: null });
  vi.restoreAllMocks();
});

it("keeps the last jobs that ended, and those of the shown capture, however many end", () => {
  useService.setState({ reconstructions: {} });
  for (let batch = 0; batch < 25; batch += 1)
    handleMessages(
      Array.from({ length: 200 }, (_, number) =>
        message("job", { ...job(`e${String(200 * batch + number)}`, "many", 1), state: "complete", queue_place: null }),
      ),
    );
  const kept = useService.getState().reconstructions;
  expect(Object.keys(kept)).toHaveLength(ENDED);
  expect(kept["e4999"]).toBeDefined();
  expect(kept["e0"]).toBeUndefined();
});

it("keeps the last captures that it was told of, those that run, the newest and the shown one, however many come", () => {
  const many = Array.from({ length: 2 * FINISHED }, (_, number) =>
    capture(`c${String(number)}`, { state: "complete" }),
  );
  const all = [
    capture("running"),
    capture("shown", { state: "complete" }),
    capture("z", { state: "complete" }),
    ...many,
  ];
  useService.setState({ captures: Object.fromEntries(all.map((one) => [one.id, one])) });
  adjust({ capture: "shown" });
  handleMessage(message("capture", capture("c0", { state: "complete" })));
  const kept = useService.getState().captures;
  expect(Object.keys(kept)).toHaveLength(FINISHED + 1);
  for (const one of ["running", "shown", "z", "c0"]) expect(kept[one]).toBeDefined();
  adjust({ capture: null });
});

it("stores messages about jobs that came together as one change", () => {
  useService.setState({ reconstructions: {} });
  let changes = 0;
  const stop = useService.subscribe(() => (changes += 1));
  const moved = Array.from({ length: 100 }, (_, at) =>
    message("job", { ...job(`q${String(at)}`, "a", 0), state: "queued", queue_place: at + 1 }),
  );
  handleMessages(moved);
  stop();
  expect(changes).toBe(1);
  expect(activeJobs(useService.getState().reconstructions)).toHaveLength(100);
});
