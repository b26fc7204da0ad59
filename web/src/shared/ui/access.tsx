/** Controls that need a scope: disabled, with the reason, if the token does not have it. */

import type { ComponentProps, JSX } from "react";

import type { Scope } from "../api/types";
import { useDenied } from "../state/access";

/** A button that changes something. While it cannot, it keeps the keyboard's focus, which `disabled` would throw away. */
export function ActionButton({
  needs = "operate",
  disabled = false,
  title,
  onClick,
  ...rest
}: ComponentProps<"button"> & { needs?: Scope }): JSX.Element {
  const denied = useDenied(needs);
  const off = disabled || denied !== null;
  return (
    <button
      type="button"
      {...rest}
      aria-disabled={off}
      title={denied ?? title}
      onClick={off ? (event) => event.preventDefault() : onClick}
    />
  );
}

/** The reason as text, for devices without tooltips; nothing if the token has the scope. */
export function ScopeNote({ needs = "operate" }: { needs?: Scope }): JSX.Element | null {
  const denied = useDenied(needs);
  return denied === null ? null : (
    <p className="dim note scope-note">
      {denied} Create one with <code>spiked token create NAME --scope {needs}</code>.
    </p>
  );
}
