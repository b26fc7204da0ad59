/** A request as React state: value, error, loading. */

import { useCallback, useEffect, useRef, useState } from "react";

import { errorText } from "./store";

export interface Fetch<T> {
  value: T | null;
  problem: string | null;
  loading: boolean;
  again: () => void;
}

/**
 * Fetch whenever `key` changes; null: no request. The last value stays while the same key is fetched again. Asked again
 * meanwhile, it fetches once more when the request is answered: requests that are slower than who asks are not dropped.
 */
export function useFetch<T>(key: string | null, ask: () => Promise<T>): Fetch<T> {
  const [round, setRound] = useState(0);
  const [state, setState] = useState<{ key: string | null; value: T | null; problem: string | null; round: number }>({
    key: null,
    value: null,
    problem: null,
    round: -1,
  });
  const underWay = useRef<string | null>(null);
  const askedAgain = useRef(false);
  useEffect(() => {
    if (key === null) return;
    let current = true;
    underWay.current = key;
    askedAgain.current = false;
    const answered = (change: Parameters<typeof setState>[0]): void => {
      if (!current) return;
      underWay.current = null;
      setState(change);
      if (askedAgain.current) setRound((n) => n + 1);
    };
    ask().then(
      (value) => answered({ key, value, problem: null, round }),
      (error: unknown) =>
        answered((old) => ({ key, value: old.key === key ? old.value : null, problem: errorText(error), round })),
    );
    return () => {
      current = false;
      underWay.current = null;
    };
    // `ask` is a new function at every rendering; `key` identifies the request.
    // eslint-disable-next-line react-hooks/exhaustive-deps
  }, [key, round]);
  const mine = state.key === key;
  return {
    value: mine ? state.value : null,
    problem: mine ? state.problem : null,
    loading: key !== null && (!mine || state.round !== round),
    again: useCallback(() => {
      if (underWay.current === null) setRound((n) => n + 1);
      else askedAgain.current = true;
    }, []),
  };
}
