/** Options by their JSON Schema: the fields of a form, their inputs, and the values that are sent. */

import type { JSX } from "react";

import type { OptionField, OptionSchema, OptionValues } from "../api/types";
import type { Named } from "./parts";

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

/** Values that no field shows: they stay as they are. */
export const withoutField = (fields: readonly Field[], values: OptionValues): OptionValues =>
  Object.fromEntries(
    Object.entries(values).filter(([key, value]) => value !== null && !fields.some((field) => field.key === key)),
  );

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

/** A source's text with options set, or removed where the text is empty. */
export function withOptions(source: string, texts: Record<string, string>): string {
  const [address = "", query = ""] = source.split("?", 2);
  const options = new URLSearchParams(query);
  for (const [key, text] of Object.entries(texts)) {
    if (text === "") options.delete(key);
    else options.set(key, text);
  }
  return options.size === 0 ? address : `${address}?${options.toString()}`;
}

/** The options that a source's text states. */
export const optionsOf = (source: string): Record<string, string> =>
  Object.fromEntries(new URLSearchParams(source.split("?", 2)[1] ?? ""));

/** The input of an option; an optional one has a choice for its default. */
export function OptionInput({
  field,
  text,
  disabled,
  onChange,
  ...called
}: {
  field: Field;
  text: string;
  disabled?: boolean;
  onChange: (text: string) => void;
} & Partial<Named>): JSX.Element {
  if (field.kind === "boolean" && !field.optional) {
    return (
      <input
        {...called}
        type="checkbox"
        checked={text === "true"}
        disabled={disabled}
        onChange={(event) => onChange(String(event.target.checked))}
      />
    );
  }
  if (field.kind === "choice" || field.kind === "boolean") {
    const choices = field.kind === "choice" ? field.choices : ["true", "false"];
    return (
      <select {...called} value={text} disabled={disabled} onChange={(event) => onChange(event.target.value)}>
        {field.optional && <option value="">default</option>}
        {choices.map((choice) => (
          <option key={choice}>{choice}</option>
        ))}
      </select>
    );
  }
  return (
    <input
      {...called}
      type={field.kind === "text" ? "text" : "number"}
      step={field.kind === "integer" ? 1 : "any"}
      min={field.minimum}
      max={field.maximum}
      required={!field.optional && field.initial !== ""}
      disabled={disabled}
      placeholder={field.optional ? "default" : ""}
      value={text}
      onChange={(event) => onChange(event.target.value)}
    />
  );
}
