/** Navigation, connection status and the current page. */

import { type JSX, useEffect, useState } from "react";

import { UploadBar } from "../features/captures/UploadBar";
import { go, type PageName, useRoute } from "../shared/state/route";
import { follow, useService } from "../shared/state/store";
import { choose, type Theme, useTheme } from "../shared/state/theme";
import { Icon, type IconName } from "../shared/ui/icons";
import { PageLink } from "../shared/ui/PageLink";
import { Toasts } from "../shared/ui/Toasts";
import { ErrorBoundary } from "./ErrorBoundary";
import { Help } from "./Help";
import { Page } from "./Page";
import { SignIn } from "./SignIn";

const TABS: readonly { page: PageName; label: string; icon: IconName; key: string }[] = [
  { page: "live", label: "Live", icon: "live", key: "1" },
  { page: "scene", label: "Scene", icon: "scene", key: "2" },
  { page: "captures", label: "Captures", icon: "captures", key: "3" },
  { page: "setup", label: "Set-up", icon: "setup", key: "4" },
];
const THEMES: Record<Theme, { next: Theme; icon: IconName; label: string }> = {
  system: { next: "dark", icon: "auto", label: "Theme: system" },
  dark: { next: "light", icon: "moon", label: "Theme: dark" },
  light: { next: "system", icon: "sun", label: "Theme: light" },
};

export function App(): JSX.Element {
  const { page } = useRoute();
  const [help, setHelp] = useState(false);
  const signedOut = useService((state) => state.signedOut);
  useEffect(() => (signedOut ? undefined : follow()), [signedOut]);
  useEffect(() => {
    const tab = TABS.find((one) => one.page === page);
    document.title = `${tab?.label ?? ""} · spiked`;
  }, [page]);
  useEffect(() => {
    // A file that is dropped beside a place for it would be opened instead of the page, and end its uploads.
    const refuse = (event: Event): void => {
      if (!(event.target instanceof HTMLInputElement && event.target.type === "file")) event.preventDefault();
    };
    const kinds = ["dragover", "drop"] as const;
    for (const kind of kinds) window.addEventListener(kind, refuse);
    return () => {
      for (const kind of kinds) window.removeEventListener(kind, refuse);
    };
  }, []);
  useEffect(() => {
    const onKey = (event: KeyboardEvent): void => {
      const typing = event.target instanceof HTMLElement && /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName);
      if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
      const tab = TABS.find((one) => one.key === event.key);
      if (tab !== undefined) go({ page: tab.page });
      if (event.key === "?") setHelp(true);
    };
    window.addEventListener("keydown", onKey);
    return () => window.removeEventListener("keydown", onKey);
  }, []);
  return (
    <>
      <a className="skip" href="#main">
        Skip to content
      </a>
      <header className="bar">
        <span className="brand">
          <svg viewBox="0 0 32 20" aria-hidden="true">
            <path d="M1 14h6l3-11 4 15 4-16 3 12h10" />
          </svg>
          spiked
        </span>
        <nav aria-label="Pages">
          {TABS.map((tab) => (
            <PageLink
              key={tab.page}
              to={{ page: tab.page }}
              aria-current={page === tab.page ? "page" : undefined}
              aria-keyshortcuts={tab.key}
            >
              <Icon name={tab.icon} />
              {tab.label}
            </PageLink>
          ))}
        </nav>
        {!signedOut && <LinkStatus />}
        <button
          type="button"
          className="bare"
          aria-label="Keys and help"
          aria-keyshortcuts="?"
          title="Keys and help (?)"
          onClick={() => setHelp(true)}
        >
          <Icon name="help" />
        </button>
        <ThemeSwitch />
      </header>
      {!signedOut && <Disconnected />}
      <UploadBar />
      <main id="main" tabIndex={-1} className={`page-${page}`}>
        {signedOut ? (
          <SignIn />
        ) : (
          <ErrorBoundary key={page}>
            <Page name={page} />
          </ErrorBoundary>
        )}
      </main>
      <Toasts />
      <Help open={help} onClose={() => setHelp(false)} />
    </>
  );
}

/** Connection status. */
function LinkStatus(): JSX.Element {
  const link = useService((state) => state.link.state);
  const connectionError = useService((state) => state.connectionError);
  const [tone, text] =
    link === "open"
      ? (["good", "connected"] as const)
      : connectionError === null
        ? (["quiet", "polling"] as const)
        : (["problem", "disconnected"] as const);
  return (
    <span
      className={`link ${tone}`}
      role="status"
      title={link === "open" ? "Live updates by WebSocket" : "No WebSocket connection"}
    >
      <i className="dot" aria-hidden="true" />
      {text}
    </span>
  );
}

function ThemeSwitch(): JSX.Element {
  const theme = THEMES[useTheme()];
  return (
    <button
      type="button"
      className="bare"
      aria-label={theme.label}
      title={theme.label}
      onClick={() => choose(theme.next)}
    >
      <Icon name={theme.icon} />
    </button>
  );
}

/** Banner while there is no connection, with the time of the next attempt. */
function Disconnected(): JSX.Element | null {
  const link = useService((state) => state.link);
  const connectionError = useService((state) => state.connectionError);
  const [now, setNow] = useState(() => performance.now());
  const shown = connectionError !== null && link.state !== "open";
  useEffect(() => {
    if (!shown) return;
    const ticking = setInterval(() => setNow(performance.now()), 500);
    return () => clearInterval(ticking);
  }, [shown]);
  if (!shown) return null;
  const wait = link.state === "waiting" ? Math.max(0, Math.ceil((link.retryAt - now) / 1000)) : 0;
  return (
    <div className="banner" role="alert">
      <Icon name="warning" />
      <span>
        {connectionError}{" "}
        <span className="dim">
          The data below may be out of date. {wait > 0 ? `Trying again in ${wait} s.` : "Trying again…"}
        </span>
      </span>
    </div>
  );
}
