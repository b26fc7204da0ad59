/** The captures that the service lists: found, filtered and sorted by it over all of them, fetched page by page. */

import { useCallback, useEffect, useRef, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Capture, CaptureSort, Grade } from "../../shared/api/types";
import type { Route } from "../../shared/state/route";
import { errorText, useService } from "../../shared/state/store";

/** More than a screen shows: drawing rows takes most of the time until the list is there, and further pages come by themselves. */
const PAGE = 25;
/** Most that one request may ask for. */
const MOST = 200;
const TYPING_MS = 200;

const FILTERS = ["", "good", "degraded", "bad", "kept", "deleted"] as const satisfies readonly (
  Grade | "" | "kept" | "deleted"
)[];
export type Filter = (typeof FILTERS)[number];
export interface Order {
  sort: CaptureSort;
  descending: boolean;
}
const SORTS: readonly CaptureSort[] = ["started", "name", "length", "size", "verdict", "reconstruction"];

/** The filter and the order that the address names. */
export const filterOf = ({ filter }: Route): Filter => FILTERS.find((one) => one === filter) ?? "";
export const orderOf = ({ sort, ascending }: Route): Order => ({
  sort: SORTS.find((one) => one === sort) ?? "started",
  descending: !ascending,
});
/** What the address names an order by. */
export const named = ({ sort, descending }: Order): Pick<Route, "sort" | "ascending"> => ({
  sort: sort === "started" ? "" : sort,
  ascending: !descending,
});

export interface Listing {
  /** What was asked for when it was answered; null before the first answer. */
  listed: Listed | null;
  problem: string | null;
  /** Captures that came after the list, where they do not belong at its beginning. */
  newer: boolean;
  more: () => void;
  again: () => void;
  forget: (id: string) => void;
}

interface Wanted extends Order {
  q: string;
  filter: Filter;
}

interface Listed extends Wanted {
  items: Capture[];
  cursor: string | null;
  total: number;
}

const newestOf = (ids: readonly string[]): string => ids.reduce((newest, id) => (id > newest ? id : newest), "");

export function useListing(q: string, filter: Filter, { sort, descending }: Order): Listing {
  const [listed, setListed] = useState<Listed | null>(null);
  const [problem, setProblem] = useState<string | null>(null);
  const [round, setRound] = useState(0);
  const [busy, setBusy] = useState(false);
  const newest = useService((state) => newestOf(Object.keys(state.captures)));
  const [upTo, setUpTo] = useState("");
  const now = useRef(listed);
  useEffect(() => {
    now.current = listed;
  });

  useEffect(() => {
    let current = true;
    const wanted = { q, filter, sort, descending };
    const fetchAll = async (): Promise<void> => {
      // The same list, fetched again, is as long as it was.
      const known = newestOf(Object.keys(useService.getState().captures));
      const shown = now.current !== null && isSame(now.current, wanted) ? now.current.items.length : 0;
      let found = await page(wanted, Math.min(MOST, Math.max(PAGE, shown)));
      while (found.items.length < shown && found.cursor !== null && current) {
        const next = await page(wanted, MOST, found.cursor);
        found = { ...next, items: [...found.items, ...next.items] };
      }
      if (!current) return;
      setListed(found);
      setUpTo(known);
      setProblem(null);
    };
    const timer = setTimeout(
      () => void fetchAll().catch((error: unknown) => current && setProblem(errorText(error))),
      now.current === null ? 0 : TYPING_MS, // nobody types before there is a list
    );
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [q, filter, sort, descending, round]);

  const waits = listed !== null && newest > upTo;
  const atTheTop = sort === "started" && descending;
  useEffect(() => {
    if (!waits || !atTheTop) return;
    let current = true;
    page({ q, filter, sort, descending }, PAGE).then(
      (found) => {
        if (!current) return;
        setUpTo(newest);
        setListed((old) => (old === null || !isSame(old, found) ? found : withFirst(old, found)));
      },
      (error: unknown) => current && setProblem(errorText(error)),
    );
    return () => {
      current = false;
    };
  }, [waits, atTheTop, newest, q, filter, sort, descending]);

  const again = useCallback(() => setRound((n) => n + 1), []);
  const forget = useCallback(
    (id: string) =>
      setListed((old) => old && { ...old, total: old.total - 1, items: old.items.filter((one) => one.id !== id) }),
    [],
  );
  const more = (): void => {
    if (busy || listed?.cursor == null) return;
    const before = listed;
    setBusy(true);
    page(before, PAGE, listed.cursor)
      .then((found) => {
        setProblem(null);
        setListed((old) =>
          old === null || !isSame(old, before) || old.cursor !== before.cursor ? old : withMore(old, found),
        );
      })
      .catch((error: unknown) => setProblem(errorText(error)))
      .finally(() => setBusy(false));
  };
  return { listed, problem, newer: waits && !atTheTop, more, again, forget };
}

const isSame = (one: Wanted, other: Wanted): boolean =>
  one.q === other.q && one.filter === other.filter && one.sort === other.sort && one.descending === other.descending;

async function page(wanted: Wanted, limit: number, cursor?: string): Promise<Listed> {
  const { q, filter, sort, descending } = wanted;
  const found = await calls.captures({
    limit,
    q,
    sort,
    descending,
    deleted: filter === "deleted",
    ...(filter === "kept" ? { keep: true } : {}),
    ...(filter === "good" || filter === "degraded" || filter === "bad" ? { grade: filter } : {}),
    ...(cursor === undefined ? {} : { cursor }),
  });
  return { q, filter, sort, descending, items: found.items, cursor: found.next_cursor, total: found.total };
}

/** The list with its next page; what was sorted elsewhere since the first one was fetched is not repeated. */
export function withMore<T extends { items: { id: string }[] }>(old: T, next: T): T {
  const ids = new Set(old.items.map((one) => one.id));
  return { ...next, items: [...old.items, ...next.items.filter((one) => !ids.has(one.id))] };
}

/** The list with a new first page of it; what follows stays, if the two meet. */
export function withFirst<T extends { items: { id: string }[]; cursor: string | null; total: number }>(
  old: T,
  first: T,
): T {
  const ids = new Set(first.items.map((one) => one.id));
  const last = first.items.at(-1)?.id ?? "";
  if (!old.items.some((one) => ids.has(one.id))) return first;
  return {
    ...old,
    total: first.total,
    items: [...first.items, ...old.items.filter((one) => !ids.has(one.id) && one.id < last)],
  };
}
