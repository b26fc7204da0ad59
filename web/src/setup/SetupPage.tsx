import type { JSX } from "react";

export function SetupPage(): JSX.Element {
  return <h1>Setup</h1>;
}
