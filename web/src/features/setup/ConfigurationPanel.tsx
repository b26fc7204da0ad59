/** The settings: what is in effect, where it comes from, and a form for those that can be changed here. */

import type { JSX } from "react";

import * as calls from "../../shared/api/calls";
import type { OptionField, OptionValues, Reloaded, Setting, Settings } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { bytes } from "../../shared/state/format";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { OptionsForm } from "../../shared/ui/OptionsForm";
import { ErrorMessage, Markup, Panel } from "../../shared/ui/parts";
import { Table } from "../../shared/ui/Table";

const COLUMNS = [{ name: "Setting" }, { name: "Value" }, { name: "From" }, { name: "A new value takes effect" }];

export function ConfigurationPanel(): JSX.Element {
  const configuration = useFetch("configuration", calls.configuration);
  const told = async (change: () => Promise<Reloaded>): Promise<void> => {
    await attempt(async () => toast(effectOf(await change())));
    configuration.again();
  };
  return (
    <Panel
      title="Configuration"
      aside={
        <button
          type="button"
          aria-disabled={configuration.loading}
          title="Read file and environment again"
          onClick={() => void told(calls.reloadConfiguration)}
        >
          <Icon name="again" /> Reload
        </button>
      }
    >
      <Fetched from={configuration} what="the configuration">
        {(found) => (
          <>
            {found.problem !== null && <ErrorMessage text={`The file cannot be loaded: ${found.problem}`} />}
            {found.needs_restart.length > 0 && (
              <p className="warning">After a restart of the service: {found.needs_restart.join(", ")}</p>
            )}
            <details>
              <summary>Change settings</summary>
              <Form found={found} onChange={(values) => told(() => calls.changeConfiguration(values))} />
            </details>
            <Table label="Table of settings" className="grid configuration" columns={COLUMNS}>
              {found.items.map((item) => (
                <Row key={item.key} setting={item} />
              ))}
            </Table>
          </>
        )}
      </Fetched>
    </Panel>
  );
}

function effectOf({ changed, needs_restart: waiting }: Reloaded): string {
  const parts = [
    changed.length > 0 ? `In effect: ${changed.join(", ")}` : "",
    waiting.length > 0 ? `after a restart: ${waiting.join(", ")}` : "",
  ].filter((part) => part !== "");
  return parts.length === 0 ? "Nothing has changed" : parts.join("; ");
}

/** Whether a value from the file would count: those of flags and of the environment win. */
const isFree = ({ editable, origin }: Setting): boolean => editable && (origin === "default" || origin === "file");

function Form({
  found,
  onChange,
}: {
  found: Settings;
  onChange: (values: OptionValues) => Promise<void>;
}): JSX.Element {
  const free = found.items.filter(isFree);
  const fixed = found.items.filter((item) => item.editable && !isFree(item));
  const properties = Object.fromEntries(free.map((item) => [item.key, described(item)]));
  const initial = Object.fromEntries(free.map((item) => [item.key, item.value]));
  const save = async (values: OptionValues): Promise<void> => {
    // The form leaves defaults out; null removes a setting from the file.
    const wanted = free.map((item) => [item.key, values[item.key] ?? null] as const);
    const isChanged = ([key, value]: readonly [string, unknown]): boolean =>
      (value ?? properties[key]?.default ?? null) !== (initial[key] ?? null) || found.needs_restart.includes(key);
    const changes = Object.fromEntries(wanted.filter(isChanged));
    if (Object.keys(changes).length === 0) toast("Nothing has changed");
    else await onChange(changes);
  };
  return (
    <>
      <p className="dim">
        Written to <code>{found.file}</code>. Who may use the service, its addresses, folders and cameras are set there,
        on its machine.
        {fixed.length > 0 &&
          ` Given at the start or by the environment, and changed there: ${fixed.map((item) => item.key).join(", ")}.`}
      </p>
      <OptionsForm
        key={JSON.stringify(initial)}
        schema={{ properties }}
        initial={initial}
        action="Save"
        onSubmit={save}
      />
    </>
  );
}

function described({ option, doc, reloadable }: Setting): OptionField {
  return {
    ...(option as OptionField),
    description: `${doc} Takes effect ${reloadable ? "at once" : "after a restart"}.`,
  };
}

function Row({ setting }: { setting: Setting }): JSX.Element {
  const { value } = setting;
  return (
    <tr>
      <th scope="row">
        <code>{setting.key}</code>
        <span className="dim">
          <Markup>{setting.doc}</Markup>
        </span>
      </th>
      <td>
        <code>{value === null ? "–" : typeof value === "string" ? value : JSON.stringify(value)}</code>
        {setting.key.endsWith("_bytes") && typeof value === "number" && <span className="dim"> {bytes(value)}</span>}
      </td>
      <td>
        <span className={setting.origin === "default" ? "dim" : ""}>{setting.origin}</span>
      </td>
      <td className="dim">{setting.reloadable ? "at once" : "after a restart"}</td>
    </tr>
  );
}
