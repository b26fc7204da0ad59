import type { JSX } from "react";

export function CapturesPage(): JSX.Element {
  return <h1>Captures</h1>;
}
