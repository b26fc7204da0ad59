/** The tokens of the service: listed, made, and revoked. */

import { type JSX, type SubmitEvent, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { NewToken, Scope, Token } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { when } from "../../shared/state/format";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { Fetched } from "../../shared/ui/Fetched";
import { Icon } from "../../shared/ui/icons";
import { Badge, Panel } from "../../shared/ui/parts";
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
  const [made, setMade] = useState<NewToken | null>(null);
  return (
    <Panel
      title="Tokens"
      aside={
        <button type="button" aria-label="Refresh the tokens" onClick={tokens.again} disabled={tokens.loading}>
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
                <Row key={token.name} token={token} onRevoked={tokens.again} />
              ))}
            </Table>
          )
        }
      </Fetched>
      {made !== null && (
        <div className="made" role="status">
          <p>
            Store the token <strong>{made.name}</strong> now: it is not shown again.
          </p>
          <p>
            <code>{made.secret}</code>{" "}
            {window.isSecureContext && (
              <button
                type="button"
                onClick={() =>
                  void attempt(async () => {
                    await navigator.clipboard.writeText(made.secret);
                    toast("Copied");
                  })
                }
              >
                Copy
              </button>
            )}{" "}
            <button type="button" onClick={() => setMade(null)}>
              Hide
            </button>
          </p>
        </div>
      )}
      <details>
        <summary>Create a token</summary>
        <Form
          onMade={(token) => {
            setMade(token);
            tokens.again();
          }}
        />
      </details>
      <p className="dim note">
        Tokens are created and revoked with a token of scope <code>admin</code>, even where none is required;{" "}
        <code>spiked token create NAME</code> makes the first.
      </p>
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
      <label>
        <span>Name</span>
        <input
          required
          maxLength={64}
          pattern="[A-Za-z0-9][A-Za-z0-9._\-]*"
          value={name}
          onChange={(event) => setName(event.target.value)}
        />
        <small className="dim">Of its user or device: letters, digits, “.”, “-” and “_”.</small>
      </label>
      <label>
        <span>Scope</span>
        <select value={scope} onChange={(event) => setScope(event.target.value as Scope)}>
          {SCOPES.map((one) => (
            <option key={one.scope} value={one.scope}>
              {one.scope}: {one.may}
            </option>
          ))}
        </select>
        <small className="dim">No more than its user needs.</small>
      </label>
      <label>
        <span>Days</span>
        <input
          type="number"
          min={0}
          step="any"
          placeholder="as yours"
          value={days}
          onChange={(event) => setDays(event.target.value)}
        />
        <small className="dim">Until it expires; no later than the token that you use.</small>
      </label>
      <div className="buttons">
        <button type="submit" className="primary" disabled={busy}>
          Create
        </button>
      </div>
    </form>
  );
}

/** Asks once more, since what the token has opened ends at once. */
function Row({ token, onRevoked }: { token: Token; onRevoked: () => void }): JSX.Element {
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
        {asked ? (
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
