import type { JSX } from "react";

export function ScenePage(): JSX.Element {
  return <h1>Scene</h1>;
}
