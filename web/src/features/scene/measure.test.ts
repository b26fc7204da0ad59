import { expect, it } from "vitest";

import type { Scale } from "../../shared/api/types";
import { MARKERS, scaleText, vectorOf } from "./measure";

const scale = (known: Partial<Scale>): Scale => ({
  revision: 1,
  metres_per_unit: null,
  sigma: null,
  source: null,
  up: null,
  version: 1,
  since: 0,
  ...known,
});

it("reads three numbers as people and spreadsheets write them", () => {
  for (const text of ["0.1 -9.7 0.9", " 0.1, -9.7, 0.9 ", "0.1;-9.7;9e-1", "0.1\t-9.7\n0.9"])
    expect(vectorOf(text)).toEqual([0.1, -9.7, 0.9]);
});

it("says what is wrong with another text", () => {
  for (const text of ["", "1 2", "1 2 3 4", "1 2 down", "1,,2", "1 2 Infinity"])
    expect(() => vectorOf(text)).toThrow("Write three numbers");
});

it("says what a scale rests on", () => {
  expect(scaleText(null)).toBe("The scale is not known: a moving camera alone knows no metres. Up is not known.");
  const by = scale({ metres_per_unit: 0.3, sigma: 0.01, source: "baseline", up: [0, -1, 0] });
  expect(scaleText(by)).toBe("A unit is 0.30000 m ± 1.0 %, by the distance of two cameras. Up is known.");
  expect(scaleText(scale({ metres_per_unit: 2, source: "board" }))).toContain("2.0000 m, by a board.");
});

it("has the names of OpenCV's markers", () => {
  expect(MARKERS).toHaveLength(16);
  expect(MARKERS).toContain("4x4_100");
});
