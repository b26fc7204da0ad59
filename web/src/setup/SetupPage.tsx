/** What the service needs of the machine, how it is configured, and where else to look. */

import { type JSX, useState } from "react";

import * as calls from "../api/calls";
import type { Finding, Setting, Token } from "../api/types";
import { bytes, duration, when } from "../state/format";
import { useService, wordsOf } from "../state/store";
import { toast } from "../state/toasts";
import { type Asked, useAsked } from "../state/useAsked";
import { Icon } from "../ui/icons";
import { Badge, Empty, Loading, Panel, type Tone, Trouble, Words } from "../ui/parts";

const TONES: Record<Finding["status"], Tone> = { ok: "good", warning: "warning", problem: "problem" };
const LINKS = [
  { href: "docs", label: "API documentation", hint: "Every call, with its answers" },
  { href: "openapi.json", label: "OpenAPI schema", hint: "To generate clients from" },
  { href: "metrics", label: "Metrics", hint: "For Prometheus" },
  { href: "healthz", label: "Health", hint: "The process answers" },
  { href: "readyz", label: "Readiness", hint: "Captures can be started" },
] as const;

export function SetupPage(): JSX.Element {
  const doctor = useAsked("doctor", calls.doctor);
  const configuration = useAsked("configuration", calls.configuration);
  const tokens = useAsked("tokens", calls.tokens);
  const system = useService((state) => state.system);
  return (
    <div className="setup">
      <h1 className="hidden">Set-up</h1>
      <div>
        <Panel
          title="Device doctor"
          aside={
            <button type="button" onClick={doctor.again} disabled={doctor.loading}>
              <Icon name="again" /> Look again
            </button>
          }
        >
          <Asking asked={doctor} what="the findings">
            {(items) =>
              items.length === 0 ? (
                <Empty icon="good" title="Nothing to look at" />
              ) : (
                <ul className="doctor">
                  {items.map((item) => (
                    <li key={item.name}>
                      <Badge tone={TONES[item.status]}>{item.status}</Badge>
                      <div>
                        <strong>{item.name}</strong>
                        <p>
                          <Words>{item.finding}</Words>
                        </p>
                        {item.what_to_do !== null && (
                          <p className="todo">
                            <Words>{item.what_to_do}</Words>
                          </p>
                        )}
                      </div>
                    </li>
                  ))}
                </ul>
              )
            }
          </Asking>
        </Panel>
        <Configuration asked={configuration} />
      </div>
      <div>
        <Panel title="Service">
          {system === null ? (
            <Loading what="the state of the service" />
          ) : (
            <dl className="facts">
              <dt>Version</dt>
              <dd>{system.version}</dd>
              <dt>Running for</dt>
              <dd>{duration(system.uptime_s)}</dd>
              <dt>Memory</dt>
              <dd>{bytes(system.memory_bytes)}</dd>
              <dt>Process</dt>
              <dd>{system.pid}</dd>
              <dt>Data folder</dt>
              <dd>
                <code>{system.data_folder}</code>
              </dd>
              <dt>Disk</dt>
              <dd>
                {bytes(system.disk.free_bytes)} free of {bytes(system.disk.total_bytes)}
              </dd>
            </dl>
          )}
        </Panel>
        <Panel
          title="Tokens"
          aside={
            <button type="button" aria-label="Look again for tokens" onClick={tokens.again} disabled={tokens.loading}>
              <Icon name="again" /> Look again
            </button>
          }
        >
          <Asking asked={tokens} what="the tokens">
            {(items) =>
              items.length === 0 ? (
                <p>None beside that of the settings, if there is one there.</p>
              ) : (
                <table className="grid">
                  <thead>
                    <tr>
                      <th scope="col">Name</th>
                      <th scope="col">Made</th>
                      <th scope="col">Opens until</th>
                    </tr>
                  </thead>
                  <tbody>
                    {items.map((token) => (
                      <tr key={token.name}>
                        <th scope="row">{token.name}</th>
                        <td className="dim">{when(token.created_at)}</td>
                        <td>{until(token)}</td>
                      </tr>
                    ))}
                  </tbody>
                </table>
              )
            }
          </Asking>
          <p className="dim note">
            <code>spiked token create NAME --days 30</code> makes one and shows it once;{" "}
            <code>spiked token revoke NAME</code> ends it at once, for this page too.
          </p>
        </Panel>
        <Panel title="Elsewhere">
          <ul className="links">
            {LINKS.map((link) => (
              <li key={link.href}>
                <a href={link.href}>{link.label}</a> <span className="dim">{link.hint}</span>
              </li>
            ))}
          </ul>
        </Panel>
        <Panel title="Keys">
          <dl className="facts">
            <dt>
              <kbd>1</kbd> – <kbd>4</kbd>
            </dt>
            <dd>Live, Scene, Captures, Set-up</dd>
            <dt>
              <kbd>←</kbd> <kbd>→</kbd>
            </dt>
            <dd>A frame back or on, in the scrubber</dd>
            <dt>
              <kbd>W A S D R F</kbd>
            </dt>
            <dd>Fly through the scene, while it has the focus</dd>
          </dl>
        </Panel>
      </div>
    </div>
  );
}

function until({ expires_at: end }: Token): JSX.Element {
  if (end === null) return <span className="dim">it is revoked</span>;
  return Date.parse(end) <= Date.now() ? <Badge tone="warning">expired {when(end)}</Badge> : <>{when(end)}</>;
}

function Asking<T>({
  asked,
  what,
  children,
}: {
  asked: Asked<T>;
  what: string;
  children: (value: T) => JSX.Element;
}): JSX.Element {
  return (
    <>
      {asked.problem !== null && <Trouble text={asked.problem} again={asked.again} />}
      {asked.value !== null ? children(asked.value) : asked.loading && <Loading what={what} />}
    </>
  );
}

function Configuration({ asked }: { asked: Asked<Setting[]> }): JSX.Element {
  const [busy, setBusy] = useState(false);
  const reload = async (): Promise<void> => {
    setBusy(true);
    try {
      await calls.reloadConfiguration();
      toast("The configuration was read again");
      asked.again();
    } catch (error) {
      toast(wordsOf(error), { tone: "problem" });
    }
    setBusy(false);
  };
  return (
    <Panel
      title="Configuration"
      aside={
        <button type="button" disabled={busy} onClick={() => void reload()}>
          <Icon name="again" /> Reload
        </button>
      }
    >
      <Asking asked={asked} what="the configuration">
        {(items) => (
          <div className="scroll" role="region" aria-label="Table of settings" tabIndex={0}>
            <table className="grid configuration">
              <thead>
                <tr>
                  <th scope="col">Setting</th>
                  <th scope="col">Value</th>
                  <th scope="col">From</th>
                  <th scope="col">Reload</th>
                </tr>
              </thead>
              <tbody>
                {items.map((item) => (
                  <tr key={item.key}>
                    <th scope="row">
                      <code>{item.key}</code>
                      <span className="dim">
                        <Words>{item.doc}</Words>
                      </span>
                    </th>
                    <td>
                      <code>
                        {item.value === null
                          ? "–"
                          : typeof item.value === "string"
                            ? item.value
                            : JSON.stringify(item.value)}
                      </code>
                    </td>
                    <td>
                      <span className={item.origin === "default" ? "dim" : ""}>{item.origin}</span>
                    </td>
                    <td className="dim">{item.reloadable ? "yes" : "restart"}</td>
                  </tr>
                ))}
              </tbody>
            </table>
          </div>
        )}
      </Asking>
    </Panel>
  );
}
