/** The sign-in form, shown in place of every page while a token is required. */

import { type JSX, type SubmitEvent, useState } from "react";

import { signIn } from "../shared/api/http";
import { signedIn, errorText } from "../shared/state/store";
import { Icon } from "../shared/ui/icons";
import { ErrorMessage } from "../shared/ui/parts";

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
      setProblem("This token is not valid.");
    } catch (error) {
      setProblem(errorText(error));
    }
    setBusy(false);
  };
  return (
    <section className="panel sign-in" aria-labelledby="sign-in">
      <h1 id="sign-in">
        <Icon name="key" /> This service requires a token
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
      {problem !== null && <ErrorMessage text={problem} />}
      <p className="dim">
        The previous token was revoked or has expired. Create another on the machine of the service with{" "}
        <code>spiked token create NAME</code>. Running captures continue.
      </p>
    </section>
  );
}
