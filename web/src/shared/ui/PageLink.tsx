/** A link within the page: no reload, but a real address for new tabs and bookmarks. */

import type { ComponentProps, JSX } from "react";

import { formatRoute, go, HOME, type Route } from "../state/route";

export function PageLink({ to, children, ...rest }: { to: Partial<Route> } & ComponentProps<"a">): JSX.Element {
  return (
    <a
      {...rest}
      href={formatRoute({ ...HOME, ...to })}
      onClick={(event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        go(to);
      }}
    >
      {children}
    </a>
  );
}
