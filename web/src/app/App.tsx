/** The frame around every page. */

import { type JSX, lazy, Suspense, useEffect, useState } from "react";

import { LivePage } from "../live/LivePage";
import { go, type PageName, useRoute } from "../state/route";
import { follow, useService } from "../state/store";
import { choose, type Theme, useTheme } from "../state/theme";
import { Icon, type IconName } from "../ui/icons";
import { Loading } from "../ui/parts";
import { Toasts } from "../ui/Toasts";
import { Guard } from "./Guard";
import { SignIn } from "./SignIn";

const ScenePage = lazy(() => import("../scene/ScenePage").then((m) => ({ default: m.ScenePage })));
const CapturesPage = lazy(() => import("../captures/CapturesPage").then((m) => ({ default: m.CapturesPage })));
const SetupPage = lazy(() => import("../setup/SetupPage").then((m) => ({ default: m.SetupPage })));

const TABS: readonly { page: PageName; label: string; icon: IconName; key: string }[] = [
  { page: "live", label: "Live", icon: "live", key: "1" },
  { page: "scene", label: "Scene", icon: "scene", key: "2" },
  { page: "captures", label: "Captures", icon: "captures", key: "3" },
  { page: "setup", label: "Set-up", icon: "setup", key: "4" },
];
const THEMES: Record<Theme, { next: Theme; icon: IconName; label: string }> = {
  system: { next: "dark", icon: "auto", label: "Theme: as the system" },
  dark: { next: "light", icon: "moon", label: "Theme: dark" },
  light: { next: "system", icon: "sun", label: "Theme: light" },
};

export function App(): JSX.Element {
  const { page } = useRoute();
  const signedOut = useService((state) => state.signedOut);
  useEffect(() => (signedOut ? undefined : follow()), [signedOut]);
  useEffect(() => {
    const tab = TABS.find((one) => one.page === page);
    document.title = `${tab?.label ?? ""} · spiked`;
  }, [page]);
  useEffect(() => {
    const onKey = (event: KeyboardEvent): void => {
      const typing = event.target instanceof HTMLElement && /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName);
      if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
      const tab = TABS.find((one) => one.key === event.key);
      if (tab !== undefined) go({ page: tab.page });
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
            <a
              key={tab.page}
              href={tab.page === "live" ? "./" : `./?page=${tab.page}`}
              aria-current={page === tab.page ? "page" : undefined}
              aria-keyshortcuts={tab.key}
              onClick={(event) => {
                if (event.ctrlKey || event.metaKey || event.shiftKey) return;
                event.preventDefault();
                go({ page: tab.page });
              }}
            >
              <Icon name={tab.icon} />
              {tab.label}
            </a>
          ))}
        </nav>
        {!signedOut && <LinkSign />}
        <ThemeSwitch />
      </header>
      {!signedOut && <Disconnected />}
      <main id="main" tabIndex={-1} className={`page-${page}`}>
        {signedOut ? (
          <SignIn />
        ) : (
          <Guard key={page}>
            <Suspense fallback={<Loading what="the page" />}>
              {page === "live" && <LivePage />}
              {page === "scene" && <ScenePage />}
              {page === "captures" && <CapturesPage />}
              {page === "setup" && <SetupPage />}
            </Suspense>
          </Guard>
        )}
      </main>
      <Toasts />
    </>
  );
}

/** Whether news arrive, in a word. */
function LinkSign(): JSX.Element {
  const link = useService((state) => state.link.state);
  const trouble = useService((state) => state.trouble);
  const [tone, text] =
    link === "open"
      ? (["good", "connected"] as const)
      : trouble === null
        ? (["quiet", "polling"] as const)
        : (["problem", "disconnected"] as const);
  return (
    <span
      className={`link ${tone}`}
      role="status"
      title={link === "open" ? "News arrive as they happen" : "No news arrive by WebSocket"}
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

/** What is shown is old: a band says so, and when the next attempt is made. */
function Disconnected(): JSX.Element | null {
  const link = useService((state) => state.link);
  const trouble = useService((state) => state.trouble);
  const [now, setNow] = useState(() => performance.now());
  const shown = trouble !== null && link.state !== "open";
  useEffect(() => {
    if (!shown) return;
    const ticking = setInterval(() => setNow(performance.now()), 500);
    return () => clearInterval(ticking);
  }, [shown]);
  if (!shown) return null;
  const wait = link.state === "waiting" ? Math.max(0, Math.ceil((link.retryAt - now) / 1000)) : 0;
  return (
    <div className="band" role="alert">
      <Icon name="warning" />
      <span>
        {trouble}{" "}
        <span className="dim">
          What is shown below may be old. {wait > 0 ? `Trying again in ${wait} s.` : "Trying again…"}
        </span>
      </span>
    </div>
  );
}
