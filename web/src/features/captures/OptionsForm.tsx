/** A form for reconstruction options, generated from their JSON Schema. */

import { type JSX, type SubmitEvent, useState } from "react";

import type { OptionField, OptionSchema, OptionValues } from "../../shared/api/types";

export interface Field {
  key: string;
  label: string;
  hint: string;
  kind: "number" | "integer" | "boolean" | "choice" | "text";
  choices: string[];
  optional: boolean;
  initial: unknown;
  minimum: number | undefined;
  maximum: number | undefined;
}

/** Fields that the form can show: numbers, switches, choices and text; others keep their defaults. */
export function fieldsOf(schema: OptionSchema): Field[] {
  return Object.entries(schema.properties ?? {}).flatMap(([key, raw]) => {
    const resolve = (field: OptionField): OptionField => {
      const name = field.$ref?.split("/").at(-1);
      return name === undefined ? field : { ...schema.$defs?.[name], ...field };
    };
    const field = resolve(raw);
    const kinds = (field.anyOf ?? [field]).map(resolve);
    const main = kinds.find((one) => one.type !== "null");
    if (main === undefined) return [];
    const kind =
      main.enum !== undefined
        ? "choice"
        : main.type === "boolean" || main.type === "integer" || main.type === "number"
          ? main.type
          : main.type === "string"
            ? "text"
            : null;
    if (kind === null) return [];
    return [
      {
        key,
        label: key.replaceAll("_", " "),
        hint: field.description ?? main.description ?? "",
        kind,
        choices: (main.enum ?? []).map(String),
        optional: kinds.some((one) => one.type === "null"),
        initial: field.default ?? null,
        minimum: main.minimum ?? main.exclusiveMinimum,
        maximum: main.maximum ?? main.exclusiveMaximum,
      },
    ];
  });
}

/** Values for the service, from the texts of the inputs; defaults are left out. */
export function valuesOf(fields: readonly Field[], texts: Record<string, string>): OptionValues {
  const values: OptionValues = {};
  for (const field of fields) {
    const text = texts[field.key];
    if (text === undefined || text === textOf(field.initial)) continue;
    if (text === "" && field.optional) values[field.key] = null;
    else if (field.kind === "number" || field.kind === "integer") values[field.key] = Number(text);
    else if (field.kind === "boolean") values[field.key] = text === "true";
    else values[field.key] = text;
  }
  return values;
}

export const textOf = (value: unknown): string =>
  value === null || value === undefined
    ? ""
    : typeof value === "object"
      ? JSON.stringify(value)
      : `${value as string | number | boolean}`;

export function OptionsForm({
  schema,
  initial,
  onSubmit,
  onCancel,
}: {
  schema: OptionSchema;
  initial: OptionValues;
  onSubmit: (values: OptionValues) => Promise<void>;
  onCancel: () => void;
}): JSX.Element {
  const fields = fieldsOf(schema);
  const [texts, setTexts] = useState<Record<string, string>>(() =>
    Object.fromEntries(fields.map((field) => [field.key, textOf(initial[field.key] ?? field.initial)])),
  );
  const [busy, setBusy] = useState(false);
  const change = (key: string, text: string): void => setTexts((old) => ({ ...old, [key]: text }));
  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    setBusy(true);
    void onSubmit(valuesOf(fields, texts)).finally(() => setBusy(false));
  };
  return (
    <form className="options" onSubmit={submit}>
      {fields.map((field) => (
        <label key={field.key}>
          <span>{field.label}</span>
          {field.kind === "boolean" ? (
            <input
              type="checkbox"
              checked={texts[field.key] === "true"}
              onChange={(event) => change(field.key, String(event.target.checked))}
            />
          ) : field.kind === "choice" ? (
            <select value={texts[field.key]} onChange={(event) => change(field.key, event.target.value)}>
              {field.optional && <option value="">default</option>}
              {field.choices.map((choice) => (
                <option key={choice}>{choice}</option>
              ))}
            </select>
          ) : (
            <input
              type={field.kind === "text" ? "text" : "number"}
              step={field.kind === "integer" ? 1 : "any"}
              min={field.minimum}
              max={field.maximum}
              required={!field.optional}
              placeholder={field.optional ? "default" : ""}
              value={texts[field.key] ?? ""}
              onChange={(event) => change(field.key, event.target.value)}
            />
          )}
          <small className="dim">{field.hint}</small>
        </label>
      ))}
      <div className="buttons">
        <button type="submit" className="primary" disabled={busy}>
          Reconstruct
        </button>
        <button type="button" onClick={onCancel}>
          Cancel
        </button>
      </div>
    </form>
  );
}
