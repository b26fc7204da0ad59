import { expect, test } from "vitest";

import { cut, NO_CUT, opened } from "./cropBox";

const BOUNDS = { low: [0, 0, 0], high: [10, 10, 10] } as const;

test("only sides that are cut from bound the box", () => {
  const shares = NO_CUT.map((_, side) => (side === 2 ? 0.05 : 0));
  const { low, high } = opened(cut(BOUNDS, shares), shares);
  expect(low[1]).toBe(0.5);
  expect([low[0], low[2]].every((value) => value < -1e6) && high.every((value) => value > 1e6)).toBe(true);
});
