/** The Set-up page: machine check, cameras, configuration, tokens, links. */

import type { JSX } from "react";

import * as calls from "../../shared/api/calls";
import type { Finding } from "../../shared/api/types";
import { allows } from "../../shared/state/access";
import { bytes, duration } from "../../shared/state/format";
import { useService } from "../../shared/state/store";
import { type Fetch, useFetch } from "../../shared/state/useFetch";
import { ScopeNote } from "../../shared/ui/access";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { SignInForm } from "../../shared/ui/SignInForm";
import { Badge, Empty, Loading, Markup, Panel, type Tone } from "../../shared/ui/parts";
import { ConfigurationPanel } from "./ConfigurationPanel";
import { ProfilePanel } from "./ProfilePanel";
import { TokensPanel } from "./TokensPanel";

const TONES: Record<Finding["status"], Tone> = { ok: "good", warning: "warning", problem: "problem" };
const LINKS = [
  { href: "docs/guide", label: "Documentation", hint: "How-tos, and the reference of commands, settings and API" },
  { href: "docs", label: "API documentation", hint: "All operations, with requests and responses" },
  { href: "openapi.json", label: "OpenAPI schema", hint: "For client generators" },
  { href: "metrics", label: "Metrics", hint: "For Prometheus" },
  { href: "healthz", label: "Health", hint: "The process answers" },
  { href: "readyz", label: "Readiness", hint: "Captures can be started" },
] as const;

export function SetupPage(): JSX.Element {
  const scope = useService((state) => state.system?.scope ?? null);
  const administrator = scope !== null && allows(scope, "admin");
  return (
    <div className="setup">
      <h1 className="hidden">Set-up</h1>
      <div>
        <Doctor />
        <ProfilePanel />
        {administrator && <ConfigurationPanel />}
      </div>
      <div>
        <Service />
        {administrator && <TokensPanel />}
        {scope !== null && !administrator && (
          <Panel title="Administration">
            <p>Configuration and tokens are hidden.</p>
            <ScopeNote needs="admin" />
            <details>
              <summary>Use another token</summary>
              <SignInForm />
            </details>
          </Panel>
        )}
        <Links />
        <Keys />
      </div>
    </div>
  );
}

function Refresh({ of, label }: { of: Fetch<unknown>; label: string }): JSX.Element {
  return (
    <button type="button" aria-label={label} onClick={of.again} aria-disabled={of.loading}>
      <Icon name="again" /> Refresh
    </button>
  );
}

function Doctor(): JSX.Element {
  const doctor = useFetch("doctor", calls.doctor);
  return (
    <Panel title="Device doctor" aside={<Refresh of={doctor} label="Refresh the findings" />}>
      <Fetched from={doctor} what="the findings">
        {(items) =>
          items.length === 0 ? (
            <Empty icon="good" title="No findings" />
          ) : (
            <ul className="doctor">
              {items.map((item) => (
                <li key={item.name}>
                  <Badge tone={TONES[item.status]}>{item.status}</Badge>
                  <div>
                    <strong>{item.name}</strong>
                    <p>
                      <Markup>{item.finding}</Markup>
                    </p>
                    {item.what_to_do !== null && (
                      <p className="todo">
                        <Markup>{item.what_to_do}</Markup>
                      </p>
                    )}
                  </div>
                </li>
              ))}
            </ul>
          )
        }
      </Fetched>
    </Panel>
  );
}

function Service(): JSX.Element {
  const system = useService((state) => state.system);
  return (
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
            {bytes(system.disk.free_bytes)} free of {bytes(system.disk.total_bytes)}:{" "}
            {duration(system.disk.recording_s)} of {system.disk.recording_of}
          </dd>
          <dt>Your scope</dt>
          <dd>{system.scope}</dd>
        </dl>
      )}
    </Panel>
  );
}

function Links(): JSX.Element {
  return (
    <Panel title="Links">
      <ul className="links">
        {LINKS.map((link) => (
          <li key={link.href}>
            <a href={link.href}>{link.label}</a> <span className="dim">{link.hint}</span>
          </li>
        ))}
      </ul>
    </Panel>
  );
}

function Keys(): JSX.Element {
  return (
    <Panel title="Keys">
      <dl className="facts">
        <dt>
          <kbd>1</kbd> – <kbd>4</kbd>
        </dt>
        <dd>Live, Scene, Captures, Set-up</dd>
        <dt>
          <kbd>←</kbd> <kbd>→</kbd>
        </dt>
        <dd>Previous or next frame, in the time slider</dd>
        <dt>
          <kbd>W A S D R F</kbd>
        </dt>
        <dd>Fly through the scene while it has the focus</dd>
      </dl>
    </Panel>
  );
}
