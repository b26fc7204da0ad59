import type { JSX } from "react";

import { dismiss, useToasts } from "../state/toasts";
import { Icon } from "./icons";
import { Markup } from "./parts";

/** The toasts shown now; announced by screen readers. */
export function Toasts(): JSX.Element {
  const toasts = useToasts((state) => state.toasts);
  return (
    <div className="toasts" role="status" aria-live="polite">
      {toasts.map((toast) => (
        <div key={toast.id} className={`toast ${toast.tone}`}>
          {toast.tone === "problem" && <Icon name="warning" />}
          <span>
            <Markup>{toast.text}</Markup>
          </span>
          {toast.action !== undefined && (
            <button
              type="button"
              onClick={() => {
                toast.action?.run();
                dismiss(toast.id);
              }}
            >
              {toast.action.label}
            </button>
          )}
          <button type="button" className="bare" aria-label="Dismiss" onClick={() => dismiss(toast.id)}>
            <Icon name="close" />
          </button>
        </div>
      ))}
    </div>
  );
}
