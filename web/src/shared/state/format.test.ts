import { expect, it } from "vitest";

import { bytes, count, duration, percent, rate, small, when } from "./format";

const plain = (text: string): string => text.replaceAll("\u202f", " ");

it.each([
  [duration(0.064), "64.0 ms"],
  [duration(0.9999), "1.00 s"],
  [duration(59.96), "60.0 s"],
  [duration(125), "2 min 05 s"],
  [duration(11520), "3 h 12 min"],
  [bytes(999), "999 B"],
  [bytes(16_000_000), "16.0 MB"],
  [rate(20_000), "20.0 kHz"],
  [count(1_234_567), "1 234 567"],
  [percent(0.5), "50 %"],
  [small(0.00031), "3.1e−4"],
  [small(null), "–"],
])("writes %s", (written, expected) => expect(plain(written)).toBe(expected));

it("names the day only when it is another", () => {
  const now = new Date("2026-11-21T12:00:00");
  expect(when("2026-11-21T07:10:00", now)).toBe("07:10:00");
  expect(when("2026-11-20T07:10:00", now)).toBe("20 Nov 2026, 07:10:00");
});
