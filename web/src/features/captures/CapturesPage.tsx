/** All captures, or one of them. */

import type { JSX } from "react";

import { useRoute } from "../../shared/state/route";
import { CaptureDetail } from "./CaptureDetail";
import { CapturesTable } from "./CapturesTable";

export function CapturesPage(): JSX.Element {
  const { capture } = useRoute();
  return capture === null ? <CapturesTable /> : <CaptureDetail key={capture} id={capture} />;
}
