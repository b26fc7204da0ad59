/** Which of the listed captures are shown, and in what order. */

import type { Capture, Grade } from "../../shared/api/types";
import { nameOf } from "../../shared/state/capture";

/** What is shown: `deleted` are listed by the service, the others are chosen among those that it lists. */
export type Filter = Grade | "" | "kept" | "deleted";
export type Order = "newest" | "oldest" | "name" | "size" | "length";

export const filtered = (captures: readonly Capture[], filter: Filter): Capture[] => {
  if (filter === "deleted") return captures.filter((one) => one.deleted_at !== null);
  return captures.filter((one) => filter === "" || (filter === "kept" ? one.keep : one.verdict?.grade === filter));
};

const ORDERS: Record<Order, (a: Capture, b: Capture) => number> = {
  newest: (a, b) => (a.id < b.id ? 1 : -1),
  oldest: (a, b) => (a.id < b.id ? -1 : 1),
  name: (a, b) => nameOf(a).localeCompare(nameOf(b)),
  size: (a, b) => (b.recording?.bytes ?? 0) - (a.recording?.bytes ?? 0),
  length: (a, b) => (b.recording?.frames ?? 0) - (a.recording?.frames ?? 0),
};

export const sorted = (captures: readonly Capture[], order: Order): Capture[] => [...captures].sort(ORDERS[order]);
