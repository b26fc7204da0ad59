/** A download that the service makes when it is asked for: what goes wrong is told, instead of a file that does not come. */

import { type JSX, type ReactNode, useState } from "react";

import { made } from "../api/calls";
import { attempt } from "../state/attempt";
import { Icon } from "./icons";

export function DownloadLink({ href, children }: { href: string; children: ReactNode }): JSX.Element {
  const [busy, setBusy] = useState(false);
  const fetchIt = async (): Promise<void> => {
    await made(href);
    const link = document.createElement("a");
    link.href = href;
    link.download = "";
    link.click();
  };
  return (
    <a
      className="button"
      href={href}
      download
      aria-disabled={busy}
      onClick={(event) => {
        event.preventDefault();
        if (busy) return;
        setBusy(true);
        void attempt(fetchIt).finally(() => setBusy(false));
      }}
    >
      <Icon name="download" /> {children}
      {busy && " is being made…"}
    </a>
  );
}
