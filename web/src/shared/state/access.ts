/** What the token of this browser allows: each scope includes those before it. */

import type { Scope } from "../api/types";
import { useService } from "./store";

const SCOPES: readonly Scope[] = ["read", "operate", "admin"];

export const allows = (own: Scope, needed: Scope): boolean => SCOPES.indexOf(own) >= SCOPES.indexOf(needed);

/** Why an action is not possible with this token; null if it is, or if the scope is not known yet. */
export function useDenied(needed: Scope): string | null {
  const own = useService((state) => state.system?.scope ?? null);
  return own === null || allows(own, needed)
    ? null
    : `Your token has the scope ${own}; this needs the scope ${needed}.`;
}
