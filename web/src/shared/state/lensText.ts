/** Focal lengths, centre and distortion as the text that sources and commands take. */

import type { Intrinsics } from "../api/types";

const OPENCV = ["k1", "k2", "p1", "p2", "k3"] as const;
const FISHEYE = ["k1", "k2", "k3", "k4"] as const;

/** `fx,fy,cx,cy`, with the coefficients after it: `k1,k2,p1,p2,k3` or `fisheye:k1,k2,k3,k4`. */
export function textOfLens({ fx, fy, cx, cy, distortion }: Intrinsics): string {
  const pinhole = [fx, fy, cx, cy].join(",");
  if (distortion == null) return pinhole;
  const named = distortion as unknown as Record<string, number>;
  const names = distortion.model === "fisheye" ? FISHEYE : OPENCV;
  const numbers = names.map((name) => named[name] ?? 0).join(",");
  return `${pinhole},${distortion.model === "fisheye" ? "fisheye:" : ""}${numbers}`;
}

/** The reverse. Throws an Error that says what is wrong. */
export function lensOfText(text: string): Intrinsics {
  const parts = text.split(",").map((part) => part.trim());
  const isFisheye = parts[4]?.startsWith("fisheye:") ?? false;
  const names = isFisheye ? FISHEYE : OPENCV;
  const numbers = parts.map((part, at) => numberOf(at === 4 ? part.replace("fisheye:", "") : part));
  const [fx, fy, cx, cy] = numbers;
  if (fx === undefined || fy === undefined || cx === undefined || cy === undefined || numbers.length > 4 + names.length)
    throw new Error("Intrinsics are fx,fy,cx,cy in pixels; coefficients of the lens may follow");
  if (numbers.length === 4) return { fx, fy, cx, cy };
  const coefficients: Record<string, number> = {};
  names.slice(0, numbers.length - 4).forEach((name, at) => (coefficients[name] = numbers[at + 4] ?? 0));
  return { fx, fy, cx, cy, distortion: { model: isFisheye ? "fisheye" : "opencv", ...coefficients } };
}

function numberOf(text: string): number {
  const value = Number(text);
  if (text === "" || !Number.isFinite(value)) throw new Error(`Intrinsics: "${text}" is not a number`);
  return value;
}
