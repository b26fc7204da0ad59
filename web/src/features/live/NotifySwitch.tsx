/** Whether the browser notifies of the end of reconstructions. */

import type { JSX } from "react";

import { setNotifying, useNotifying } from "../../shared/state/notifying";

export function NotifySwitch(): JSX.Element {
  const notifying = useNotifying();
  return (
    <label className="check" title="By this browser, when a reconstruction ends and the page is not in front">
      <input type="checkbox" checked={notifying} onChange={(event) => void setNotifying(event.target.checked)} /> Notify
      me at the end
    </label>
  );
}
