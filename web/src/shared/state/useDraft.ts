/** The text of a field that others may change, too: only what was typed here is saved, when the field is left. */

import { type ChangeEvent, type KeyboardEvent, useState } from "react";

type Field = HTMLInputElement | HTMLTextAreaElement;

export interface Draft {
  value: string;
  onChange: (event: ChangeEvent<Field>) => void;
  onBlur: () => void;
  onKeyDown: (event: KeyboardEvent<Field>) => void;
}

/** `save` answers whether the text was stored; one that was not stays in the field. Escape takes back what was typed. */
export function useDraft(stored: string, save: (text: string) => Promise<boolean>): Draft {
  const [draft, setDraft] = useState<string | null>(null);
  const leave = async (): Promise<void> => {
    if (draft === null) return;
    if (draft === stored || (await save(draft))) setDraft((now) => (now === draft ? null : now));
  };
  return {
    value: draft ?? stored,
    onChange: (event) => setDraft(event.target.value),
    onBlur: () => void leave(),
    onKeyDown: (event) => {
      if (event.key === "Enter" && event.currentTarget instanceof HTMLInputElement) event.currentTarget.blur();
      if (event.key === "Escape") setDraft(null);
    },
  };
}
