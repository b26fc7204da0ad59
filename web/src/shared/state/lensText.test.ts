import { expect, it } from "vitest";

import { lensOfText, textOfLens } from "./lensText";

it.each(["900.5,900,500,499.5", "190,190,200,125,fisheye:0.02,-0.01,0,0", "346,346,200,125,-0.3,0.1,0.001,-0.002,0"])(
  "writes and reads %s",
  (text) => {
    expect(textOfLens(lensOfText(text))).toBe(text);
  },
);

it("fills coefficients that are left out", () => {
  expect(lensOfText("1, 1, 0, 0, -0.3")).toEqual({
    ...{ fx: 1, fy: 1, cx: 0, cy: 0 },
    distortion: { model: "opencv", k1: -0.3 },
  });
});

it.each(["", "1,2,3", "a,1,2,3", "1,1,0,0,", "1,1,0,0,1,2,3,4,5,6", "1,1,0,0,fisheye:1,2,3,4,5"])(
  "refuses %j",
  (text) => {
    expect(() => lensOfText(text)).toThrow(/Intrinsics/);
  },
);
