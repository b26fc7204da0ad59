import { expect, test } from "vitest";

import { dragged, intervals, isPixel, within } from "./region";

const SIZE = { width: 400, height: 250 };

test("a drag in any direction is the pixels between its corners, within the picture", () => {
  expect(dragged([10.2, 20.9], [19.9, 24.1], SIZE)).toEqual({ x: 10, y: 20, width: 10, height: 5 });
  expect(dragged([19.9, 24.1], [10.2, 20.9], SIZE)).toEqual({ x: 10, y: 20, width: 10, height: 5 });
  expect(dragged([-30, -1], [999, 999], SIZE)).toEqual({ x: 0, y: 0, width: 400, height: 250 });
});

test("a click is a pixel", () => {
  const pixel = dragged([399.7, 249.2], [400.4, 250.1], SIZE);
  expect(pixel).toEqual({ x: 399, y: 249, width: 1, height: 1 });
  expect(isPixel(pixel)).toBe(true);
  expect(isPixel(dragged([1, 1], [1.5, 40], SIZE))).toBe(false);
});

test("typed numbers are kept within the picture", () => {
  expect(within({ x: 390, y: -5, width: 50, height: 0 }, SIZE)).toEqual({ x: 390, y: 0, width: 10, height: 1 });
});

test("intervals between spikes have a mean and a deviation", () => {
  expect(intervals([7])).toBeNull();
  expect(intervals([0, 10, 20, 30])).toEqual({ mean: 10, deviation: 0 });
  expect(intervals([0, 8, 20])).toEqual({ mean: 10, deviation: 2 });
});
