/** A request as React state: value, error, loading. */

import { useCallback, useEffect, useState } from "react";

import { errorText } from "./store";

export interface Fetch<T> {
  value: T | null;
  problem: string | null;
  loading: boolean;
  again: () => void;
}

/** Fetch whenever `key` changes; null: no request. The last value stays while the same key is fetched again. */
export function useFetch<T>(key: string | null, ask: () => Promise<T>): Fetch<T> {
  const [round, setRound] = useState(0);
  const [state, setState] = useState<{ key: string | null; value: T | null; problem: string | null; round: number }>({
    key: null,
    value: null,
    problem: null,
    round: -1,
  });
  useEffect(() => {
    if (key === null) return;
    let current = true;
    ask().then(
      (value) => current && setState({ key, value, problem: null, round }),
      (error: unknown) =>
        current &&
        setState((old) => ({ key, value: old.key === key ? old.value : null, problem: errorText(error), round })),
    );
    return () => {
      current = false;
    };
    // `ask` is a new function at every rendering; `key` identifies the request.
    // eslint-disable-next-line react-hooks/exhaustive-deps
  }, [key, round]);
  const mine = state.key === key;
  return {
    value: mine ? state.value : null,
    problem: mine ? state.problem : null,
    loading: key !== null && (!mine || state.round !== round),
    again: useCallback(() => setRound((n) => n + 1), []),
  };
}
