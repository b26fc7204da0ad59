/** Theme: as the system, or as chosen in this browser. */

import { useSyncExternalStore } from "react";

export type Theme = "system" | "dark" | "light";
const KEY = "spiked.theme";
const listeners = new Set<() => void>();
const dark = window.matchMedia("(prefers-color-scheme: dark)");

function stored(): Theme {
  try {
    const value = localStorage.getItem(KEY);
    return value === "dark" || value === "light" ? value : "system";
  } catch {
    return "system"; // storage may be forbidden; the page works without
  }
}

let chosen = stored();
const notify = (): void => {
  for (const listener of listeners) listener();
};
dark.addEventListener("change", notify);

export const isDark = (): boolean => (chosen === "system" ? dark.matches : chosen === "dark");

export function applyTheme(): void {
  if (chosen === "system") delete document.documentElement.dataset["theme"];
  else document.documentElement.dataset["theme"] = chosen;
}

export function choose(theme: Theme): void {
  chosen = theme;
  try {
    if (theme === "system") localStorage.removeItem(KEY);
    else localStorage.setItem(KEY, theme);
  } catch {
    // as above: the choice lasts until the page is closed
  }
  applyTheme();
  notify();
}

const subscribe = (listener: () => void): (() => void) => {
  listeners.add(listener);
  return () => listeners.delete(listener);
};
export const useTheme = (): Theme => useSyncExternalStore(subscribe, () => chosen);
export const useDark = (): boolean => useSyncExternalStore(subscribe, isDark);

/** A colour of the style sheet as it is inside an element, for canvases: the variable itself is of both themes. */
export function colour(name: string, within: Element = document.body): string {
  const probe = document.createElement("i");
  probe.style.color = `var(--${name})`;
  within.append(probe);
  const resolved = getComputedStyle(probe).color;
  probe.remove();
  return resolved;
}
