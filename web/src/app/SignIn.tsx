/** The service no longer takes the token of this page, or never had one: what takes the place of every page then. */

import { type JSX, type SubmitEvent, useState } from "react";

import { signIn } from "../api/http";
import { signedIn, wordsOf } from "../state/store";
import { Icon } from "../ui/icons";
import { Trouble } from "../ui/parts";

export function SignIn(): JSX.Element {
  const [token, setToken] = useState("");
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<string | null>(null);
  const submit = async (): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      if (await signIn(token)) {
        signedIn();
        return;
      }
      setProblem("This token does not open the service.");
    } catch (error) {
      setProblem(wordsOf(error));
    }
    setBusy(false);
  };
  return (
    <section className="panel sign-in" aria-labelledby="sign-in">
      <h1 id="sign-in">
        <Icon name="key" /> This service needs its token
      </h1>
      <form
        onSubmit={(event: SubmitEvent) => {
          event.preventDefault();
          void submit();
        }}
      >
        <label htmlFor="token">Token</label>
        <input
          id="token"
          type="password"
          required
          autoComplete="current-password"
          value={token}
          onChange={(event) => setToken(event.target.value)}
        />
        <button type="submit" className="primary" disabled={busy}>
          Sign in
        </button>
      </form>
      {problem !== null && <Trouble text={problem} />}
      <p className="dim">
        The one used so far was revoked, or has expired. Whoever runs the service makes another with{" "}
        <code>spiked token create NAME</code>. A capture that runs goes on meanwhile.
      </p>
    </section>
  );
}
