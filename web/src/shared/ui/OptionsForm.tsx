/** A form for options, generated from their JSON Schema. */

import { type JSX, type ReactNode, type SubmitEvent, useState } from "react";

import type { OptionSchema, OptionValues } from "../api/types";
import { bytes } from "../state/format";
import { ActionButton } from "./access";
import { type Field, fieldsOf, OptionInput, textOf, valuesOf, withoutField } from "./options";
import { Labelled, Markup } from "./parts";

export function OptionsForm({
  schema,
  initial,
  action,
  onSubmit,
  onCancel,
  onChange,
  children,
}: {
  schema: OptionSchema;
  initial: OptionValues;
  /** Label of the button that submits. */
  action: string;
  onSubmit: (values: OptionValues) => Promise<void>;
  onCancel?: () => void;
  /** Told of all values while they are changed. */
  onChange?: (values: OptionValues) => void;
  /** Further inputs, below those of the schema. */
  children?: ReactNode;
}): JSX.Element {
  const fields = fieldsOf(schema);
  const [texts, setTexts] = useState<Record<string, string>>(() =>
    Object.fromEntries(fields.map((field) => [field.key, textOf(initial[field.key] ?? field.initial)])),
  );
  const hidden = withoutField(fields, initial);
  const [busy, setBusy] = useState(false);
  const change = (key: string, text: string): void => {
    const now = { ...texts, [key]: text };
    setTexts(now);
    onChange?.({ ...hidden, ...valuesOf(fields, now) });
  };
  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    setBusy(true);
    void onSubmit({ ...hidden, ...valuesOf(fields, texts) }).finally(() => setBusy(false));
  };
  return (
    <form className="options" onSubmit={submit}>
      {fields.map((field) => (
        <Labelled key={field.key} label={field.label} hint={<Hint field={field} text={texts[field.key] ?? ""} />}>
          {(called) => (
            <OptionInput
              {...called}
              field={field}
              text={texts[field.key] ?? ""}
              onChange={(text) => change(field.key, text)}
            />
          )}
        </Labelled>
      ))}
      {children}
      <div className="buttons">
        <ActionButton type="submit" className="primary" disabled={busy}>
          {action}
        </ActionButton>
        {onCancel !== undefined && (
          <button type="button" onClick={onCancel}>
            Cancel
          </button>
        )}
      </div>
    </form>
  );
}

/** What an option is; of a number of bytes also how much that is. */
function Hint({ field, text }: { field: Field; text: string }): JSX.Element {
  return (
    <>
      {field.key.endsWith("_bytes") && text !== "" && <b>{bytes(Number(text))}. </b>}
      <Markup>{field.hint}</Markup>
    </>
  );
}
