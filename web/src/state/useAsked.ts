/** What was asked of the service, while it is asked, when it came and when it failed. */

import { useCallback, useEffect, useState } from "react";

import { wordsOf } from "./store";

export interface Asked<T> {
  value: T | null;
  problem: string | null;
  loading: boolean;
  again: () => void;
}

/** Ask whenever `key` changes; null asks for nothing. The last value stays while a new one of the same key is asked for. */
export function useAsked<T>(key: string | null, ask: () => Promise<T>): Asked<T> {
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
        setState((old) => ({ key, value: old.key === key ? old.value : null, problem: wordsOf(error), round })),
    );
    return () => {
      current = false;
    };
    // `ask` is a new function at every rendering; what it asks for is named by `key`.
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
