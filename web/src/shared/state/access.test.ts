import { expect, test } from "vitest";

import { allows } from "./access";

test("each scope includes those before it", () => {
  expect(allows("read", "operate")).toBe(false);
  expect(allows("operate", "operate")).toBe(true);
  expect(allows("operate", "admin")).toBe(false);
  expect(allows("admin", "read")).toBe(true);
});
