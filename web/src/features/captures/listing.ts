/** Which of the listed captures are shown, and in what order. */

import type { Capture, Grade } from "../../shared/api/types";
import { nameOf } from "../../shared/state/capture";

export type GradeFilter = Grade | "" | "kept";
export type Order = "newest" | "oldest" | "name" | "size" | "length";

export const filtered = (captures: readonly Capture[], grade: GradeFilter): Capture[] =>
  captures.filter((one) => grade === "" || (grade === "kept" ? one.keep : one.verdict?.grade === grade));

const ORDERS: Record<Order, (a: Capture, b: Capture) => number> = {
  newest: (a, b) => (a.id < b.id ? 1 : -1),
  oldest: (a, b) => (a.id < b.id ? -1 : 1),
  name: (a, b) => nameOf(a).localeCompare(nameOf(b)),
  size: (a, b) => (b.recording?.bytes ?? 0) - (a.recording?.bytes ?? 0),
  length: (a, b) => (b.recording?.frames ?? 0) - (a.recording?.frames ?? 0),
};

export const sorted = (captures: readonly Capture[], order: Order): Capture[] => [...captures].sort(ORDERS[order]);
