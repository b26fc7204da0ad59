import { act, createElement, useEffect } from "react";
import { createRoot } from "react-dom/client";
import { afterEach, beforeEach, expect, it, vi } from "vitest";

import { type Fetch, useFetch } from "./useFetch";

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal("IS_REACT_ACT_ENVIRONMENT", true);
});
afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

const ANSWER_MS = 5000;
const POLL_MS = 2000;
const STEP_MS = 100;

it("shows answers that take longer than the time between two questions, and asks once more after each", async () => {
  let asked = 0;
  const shown: (number | null)[] = [];
  const ask = (): Promise<number> => {
    const mine = ++asked;
    return new Promise((done) => setTimeout(() => done(mine), ANSWER_MS));
  };
  function Polling(): null {
    const fetched: Fetch<number> = useFetch("log", ask);
    const { again, value } = fetched;
    useEffect(() => {
      const timer = setInterval(again, POLL_MS);
      return () => clearInterval(timer);
    }, [again]);
    useEffect(() => void shown.push(value), [value]);
    return null;
  }
  const root = createRoot(document.createElement("div"));
  act(() => root.render(createElement(Polling)));
  for (let ms = 0; ms < 3 * ANSWER_MS + POLL_MS; ms += STEP_MS)
    await act(async () => {
      await vi.advanceTimersByTimeAsync(STEP_MS);
    });
  expect(shown).toEqual([null, 1, 2, 3]);
  act(() => root.unmount());
  const before = asked;
  await vi.advanceTimersByTimeAsync(60_000);
  expect(asked).toBe(before); // nobody looks any more
});
