/** The tokens of the service: listed, made, and revoked. */

import { type JSX, type SubmitEvent, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { NewToken, Scope, Token } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { copy } from "../../shared/state/clipboard";
import { when } from "../../shared/state/format";
import { useService } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { Badge, Labelled, Panel } from "../../shared/ui/parts";
import { SignInForm } from "../../shared/ui/SignInForm";
import { Table } from "../../shared/ui/Table";

const COLUMNS = [
  { name: "Name" },
  { name: "Scope" },
  { name: "Created" },
  { name: "Expires" },
  { name: "Actions", hidden: true },
];
const SCOPES: readonly { scope: Scope; may: string }[] = [
  { scope: "read", may: "view and download" },
  { scope: "operate", may: "also start, change and remove captures" },
  { scope: "admin", may: "also settings and tokens" },
];

export function TokensPanel(): JSX.Element {
  const tokens = useFetch("tokens", calls.tokens);
  const system = useService((state) => state.system);
  const [made, setMade] = useState<NewToken | null>(null);
  return (
    <Panel
      title="Tokens"
      aside={
        <button type="button" aria-label="Refresh the tokens" onClick={tokens.again} aria-disabled={tokens.loading}>
          <Icon name="again" /> Refresh
        </button>
      }
    >
      <Fetched from={tokens} what="the tokens">
        {(items) =>
          items.length === 0 ? (
            <p>No tokens, other than one in the settings, if any.</p>
          ) : (
            <Table label="Table of tokens" className="grid" columns={COLUMNS}>
              {items.map((token) => (
                <Row
                  mayRevoke={system?.token_scope === "admin"}
                  key={token.name}
                  token={token}
                  onRevoked={() => {
                    if (made?.name === token.name) setMade(null);
                    tokens.again();
                  }}
                />
              ))}
            </Table>
          )
        }
      </Fetched>
      {made !== null && (
        <div className="made" role="status">
          <p>
            Store the token <strong>{made.name}</strong> now: it is not shown again. Programs send it as{" "}
            <code>Authorization: Bearer TOKEN</code>, browsers ask for it.
          </p>
          <p>
            <code>{made.secret}</code>{" "}
            <button
              type="button"
              onClick={() =>
                void attempt(async () => {
                  await copy(made.secret);
                  toast("Copied");
                })
              }
            >
              Copy
            </button>{" "}
            <button type="button" onClick={() => setMade(null)}>
              Hide
            </button>
          </p>
        </div>
      )}
      {system?.token_required === false && (
        <p className="dim note">
          This service listens to its own machine only, and requires no token: tokens limit nothing until{" "}
          <code>require_token</code> is set or it listens elsewhere.
        </p>
      )}
      {system !== null && system.token_scope !== "admin" ? (
        <details>
          <summary>Create or revoke a token</summary>
          <p>
            That needs a token of scope <code>admin</code>. <code>spiked token create NAME</code> on the machine of the
            service makes the first; enter it here.
          </p>
          <SignInForm />
        </details>
      ) : (
        <details>
          <summary>Create a token</summary>
          <Form
            onMade={(token) => {
              setMade(token);
              tokens.again();
            }}
          />
        </details>
      )}
    </Panel>
  );
}

function Form({ onMade }: { onMade: (token: NewToken) => void }): JSX.Element {
  const [name, setName] = useState("");
  const [scope, setScope] = useState<Scope>("read");
  const [days, setDays] = useState("90");
  const [busy, setBusy] = useState(false);
  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    setBusy(true);
    const create = async (): Promise<void> => {
      onMade(await calls.createToken({ name, scope, days: days === "" ? null : Number(days) }));
      setName("");
    };
    void attempt(create).finally(() => setBusy(false));
  };
  return (
    <form className="options" onSubmit={submit}>
      <Labelled label="Name" hint="Of its user or device: letters, digits, “.”, “-” and “_”.">
        {(called) => (
          <input
            {...called}
            required
            maxLength={64}
            pattern="[A-Za-z0-9][A-Za-z0-9._\-]*"
            value={name}
            onChange={(event) => setName(event.target.value)}
          />
        )}
      </Labelled>
      <Labelled label="Scope" hint="No more than its user needs.">
        {(called) => (
          <select {...called} value={scope} onChange={(event) => setScope(event.target.value as Scope)}>
            {SCOPES.map((one) => (
              <option key={one.scope} value={one.scope}>
                {one.scope}: {one.may}
              </option>
            ))}
          </select>
        )}
      </Labelled>
      <Labelled label="Days" hint="Until it expires; no later than the token that you use.">
        {(called) => (
          <input
            {...called}
            type="number"
            min={0}
            step="any"
            placeholder="as yours"
            value={days}
            onChange={(event) => setDays(event.target.value)}
          />
        )}
      </Labelled>
      <div className="buttons">
        <button type="submit" className="primary" disabled={busy}>
          Create
        </button>
      </div>
    </form>
  );
}

/** Asks once more, since what the token has opened ends at once. */
function Row({
  token,
  mayRevoke,
  onRevoked,
}: {
  token: Token;
  mayRevoke: boolean;
  onRevoked: () => void;
}): JSX.Element {
  const [asked, setAsked] = useState(false);
  const revoke = async (): Promise<void> => {
    if (await attempt(() => calls.revokeToken(token.name))) toast(`Revoked ${token.name}`);
    onRevoked();
  };
  return (
    <tr>
      <th scope="row">
        {token.name}
        {token.created_by !== null && <span className="dim"> made with {token.created_by}</span>}
      </th>
      <td>{token.scope}</td>
      <td className="dim">{when(token.created_at)}</td>
      <td>{expiry(token)}</td>
      <td className="number">
        {!mayRevoke ? null : asked ? (
          <button type="button" onClick={() => void revoke()}>
            Revoke at once
          </button>
        ) : (
          <button type="button" className="bare" aria-label={`Revoke ${token.name}`} onClick={() => setAsked(true)}>
            <Icon name="trash" />
          </button>
        )}
      </td>
    </tr>
  );
}

function expiry({ expires_at: end }: Token): JSX.Element {
  if (end === null) return <span className="dim">never</span>;
  return Date.parse(end) <= Date.now() ? <Badge tone="warning">expired {when(end)}</Badge> : <>{when(end)}</>;
}
