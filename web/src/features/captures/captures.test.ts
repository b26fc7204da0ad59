import { describe, expect, it } from "vitest";

import type { Timeline, Upload } from "../../shared/api/types";
import { fieldsOf, optionsOf, valuesOf, withOptions } from "../../shared/ui/options";
import { along, flicker, hasWork, joined } from "./series";
import { thinned } from "./thinned";
import { rememberFile, whyNot } from "./rememberedFiles";
import { withFirst, withMore } from "./useListing";
import { merged } from "../live/Histogram";

const SCHEMA = {
  $defs: { Mode: { type: "string", enum: ["fast", "exact"] } },
  properties: {
    steps: { type: "integer", default: 2000, minimum: 0, description: "Gradient steps" },
    mode: { $ref: "#/$defs/Mode", default: "fast" },
    limit_s: { anyOf: [{ type: "number" }, { type: "null" }], default: null },
    flicker: { type: "boolean", default: true },
    nested: { type: "object" },
  },
};

it("makes a field of each option that a form can show", () => {
  expect(fieldsOf(SCHEMA).map((field) => [field.key, field.kind, field.optional])).toEqual([
    ["steps", "integer", false],
    ["mode", "choice", false],
    ["limit_s", "number", true],
    ["flicker", "boolean", false],
  ]);
});

it("sends what differs from the defaults, with its type", () => {
  const fields = fieldsOf(SCHEMA);
  expect(valuesOf(fields, { steps: "2000", mode: "exact", limit_s: "", flicker: "false" })).toEqual({
    mode: "exact",
    flicker: false,
  });
  expect(valuesOf(fields, { steps: "10", limit_s: "2.5" })).toEqual({ steps: 10, limit_s: 2.5 });
});

it("writes options into the text of a source", () => {
  expect(withOptions("sim:?width=96", { mosaic: "BGGR", width: "" })).toBe("sim:?mosaic=BGGR");
  expect(withOptions("pcie:/dev/card", { intrinsics: "1,2,3,4" })).toBe("pcie:/dev/card?intrinsics=1%2C2%2C3%2C4");
  expect(withOptions("usb0", {})).toBe("usb0");
  expect(optionsOf("sim:?width=96&mosaic=BGGR")).toEqual({ width: "96", mosaic: "BGGR" });
});

it("joins two timelines on one axis", () => {
  expect(
    joined(
      [
        [0, 1, 2],
        [1, 3],
      ],
      [
        [10, 11, 12],
        [21, 23],
      ],
    ),
  ).toEqual([
    [0, 1, 2, 3],
    [10, 11, 12, null],
    [null, 21, null, 23],
  ]);
});

it("finds the swing of mains light and nothing in steady light", () => {
  const times = Array.from({ length: 500 }, (_, i) => i * 0.0004);
  const line = (rate: number[]): Timeline => ({ time_s: times, rate }) as unknown as Timeline;
  const swing = flicker(line(times.map((t) => 0.3 * (1 + 0.1 * Math.sin(2 * Math.PI * 100 * t)))));
  const middle = swing.slice(50, 450).map((x) => x ?? 0);
  expect(Math.max(...middle)).toBeCloseTo(10, 0);
  const steady = flicker(line(times.map(() => 0.3)));
  expect(Math.max(...steady.map((x) => Math.abs(x ?? 0)))).toBeLessThan(1e-7);
});

it("joins the bins of a histogram of few frames", () => {
  const comb = {
    edges: Array.from({ length: 17 }, (_, i) => i / 16),
    counts: [1, 0, 4, 0, 9, 0, 6, 0, 2, 0, 1, 0, 0, 0, 0, 0],
  };
  expect(merged(comb).counts).toEqual([1, 4, 9, 6, 2, 1, 0, 0]);
  expect(merged(comb).edges[8]).toBe(1);
  const full = { edges: comb.edges, counts: comb.counts.map(() => 2) };
  expect(merged(full)).toEqual(full);
});

describe("poses of a file that is sent", () => {
  it("a long one is thinned, and keeps its ends", () => {
    const lines = Array.from({ length: 100 }, (_, at) => `${at} 0 0 0 0 0 0 1`);
    const file = `# time\n${lines.join("\n")}\n`;
    expect(thinned(file)).toEqual({ text: `${lines.join("\n")}\n`, every: 1 });
    const { text, every } = thinned(file, file.length / 3 + 1);
    const kept = text.trim().split("\n");
    expect(every).toBe(3);
    expect(kept).toEqual(lines.filter((_, at) => at % 3 === 0));
    expect(kept.at(-1)).toBe(lines.at(-1));
    expect(() => thinned("# nothing\n")).toThrow("no poses");
  });
});

describe("a new first page of the list", () => {
  const list = (ids: string[], cursor: string | null, total: number) => ({
    items: ids.map((id) => ({ id })),
    cursor,
    total,
  });

  it("comes before what was fetched, which stays", () => {
    const old = list(["e", "d", "c", "b"], "b", 5);
    expect(withFirst(old, list(["g", "e", "c"], "c", 6))).toEqual(list(["g", "e", "c", "b"], "b", 6));
  });

  it("replaces a list that it does not meet", () => {
    const first = list(["i", "h"], "h", 9);
    expect(withFirst(list(["c", "b"], "b", 5), first)).toBe(first);
  });
});

it("shows a capture once that was sorted elsewhere between two pages", () => {
  const list = (ids: string[]): { items: { id: string }[] } => ({ items: ids.map((id) => ({ id })) });
  expect(withMore(list(["a", "b"]), list(["b", "c"]))).toEqual(list(["a", "b", "c"]));
});

describe("the file of an upload that goes on", () => {
  const file = new File(["spikes"], "garden.dat", { lastModified: 5 });
  const upload = { id: "u", name: "Garden", bytes: file.size, offset_bytes: 3 } as unknown as Upload;

  it("is not told in a browser that did not begin it", () => {
    expect(whyNot(upload, file)).toMatch("did not begin");
  });

  it("is that of the same name, size and time, whatever the capture is called", () => {
    rememberFile("u", file, false);
    expect(whyNot(upload, file)).toBeNull();
    expect(whyNot(upload, new File(["spikes"], "room.dat", { lastModified: 5 }))).toMatch("was begun with garden.dat");
    expect(whyNot(upload, new File(["spike"], "garden.dat", { lastModified: 5 }))).toMatch("bytes");
    expect(whyNot(upload, new File(["spikes"], "garden.dat", { lastModified: 6 }))).toMatch("was changed");
  });
});

describe("plots over seconds of work", () => {
  const timeline = {
    time_s: [0.1, 0.2, 0.3],
    work_s: [null, 2, 3],
    chi2: [1, 2, 3],
    loss: [0.3, 0.2, 0.1],
    work: { work_s: [2, 3, 9], loss: [0.3, 0.2, 0.01], psnr_db: [5, 7, 20], splats: [1, 2, 3] },
  } as unknown as Timeline;

  it("show the map after the last frame, and views where their work is known", () => {
    expect(along(timeline, "loss", "capture")).toEqual([timeline.time_s, timeline.loss]);
    expect(along(timeline, "loss", "work")).toEqual([
      [2, 3, 9],
      [0.3, 0.2, 0.01],
    ]);
    expect(along(timeline, "chi2", "work")).toEqual([
      [2, 3],
      [2, 3],
    ]);
  });

  it("are not offered where no work was noted", () => {
    expect(hasWork(timeline)).toBe(true);
    const old = { work_s: [null, null], work: { work_s: [] } } as unknown as Timeline;
    expect(hasWork(old)).toBe(false);
  });
});
