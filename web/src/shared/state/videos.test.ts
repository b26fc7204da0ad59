import { expect, it } from "vitest";

import { problemOf, slownessFor } from "./videos";

it("shows a capture of any length within about ten seconds, but never faster than it was", () => {
  expect(slownessFor(0.051)).toBe(200);
  expect(slownessFor(2.5)).toBe(4);
  expect(slownessFor(300)).toBe(1);
  expect(slownessFor(0)).toBe(1);
});

it("says why a video cannot be made", () => {
  expect(problemOf(10, 30)).toBeNull();
  expect(problemOf(1200, 30)).toBeNull();
  expect(problemOf(1201, 1)).toContain("20 minutes");
  expect(problemOf(600, 61)).toContain("36,000 pictures");
  expect(problemOf(0.05, 30)).toContain("more slowly");
  expect(problemOf(Number.NaN, 30)).toContain("Fill in");
  expect(problemOf(10, 0)).toContain("Fill in");
});
