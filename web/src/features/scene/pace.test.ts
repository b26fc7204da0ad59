import { expect, it } from "vitest";

import { Pace } from "./pace";

/** So many pictures, each asked for `everyMs` after the one before and drawn `tookMs` later. */
function draw(pace: Pace, count: number, everyMs: number, tookMs: number, moving = true): void {
  for (let i = 1; i <= count; i += 1) {
    pace.request(i * everyMs);
    pace.drawn(i * everyMs + tookMs, moving);
  }
}

it("does not take rare pictures for slow ones", () => {
  const pace = new Pace(false);
  draw(pace, 20, 200, 10);
  expect(pace.slow).toBe(false);
});

it("finds slow pictures of a moving view, and that they are fast again", () => {
  const pace = new Pace(false);
  draw(pace, 10, 60, 50, false);
  draw(pace, 2, 60, 50);
  expect(pace.slow).toBe(false);
  draw(pace, 1, 60, 50);
  expect(pace.slow).toBe(true);
  draw(pace, 29, 16, 10);
  expect(pace.slow).toBe(true);
  draw(pace, 1, 16, 10);
  expect(pace.slow).toBe(false);
});

it("keeps a machine without graphics hardware slow", () => {
  const pace = new Pace(true);
  draw(pace, 100, 16, 5);
  expect(pace.slow).toBe(true);
});
