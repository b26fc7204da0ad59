/** A value that is fetched: an error with a retry button, a loading message, or the rendered value. */

import type { JSX } from "react";

import type { Fetch } from "../state/useFetch";
import { ErrorMessage, Loading } from "./parts";

export function Fetched<T>({
  from,
  what,
  children,
}: {
  from: Fetch<T>;
  /** Name of the value, for the loading message. */
  what: string;
  children: (value: T) => JSX.Element;
}): JSX.Element {
  return (
    <>
      {from.problem !== null && <ErrorMessage text={from.problem} again={from.again} />}
      {from.value !== null ? children(from.value) : from.loading && <Loading what={what} />}
    </>
  );
}
