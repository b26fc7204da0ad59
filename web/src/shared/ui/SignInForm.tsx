/** The form that takes a token, which this browser then sends with each request. */

import { type JSX, type SubmitEvent, useId, useState } from "react";

import { signIn } from "../api/http";
import { errorText, signedIn } from "../state/store";
import { ErrorMessage } from "./parts";

export function SignInForm(): JSX.Element {
  const [token, setToken] = useState("");
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<string | null>(null);
  const id = useId();
  const submit = async (): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      if (await signIn(token)) {
        setToken("");
        signedIn();
      } else setProblem("This token is not valid.");
    } catch (error) {
      setProblem(errorText(error));
    }
    setBusy(false);
  };
  return (
    <>
      <form
        className="sign-in-form"
        onSubmit={(event: SubmitEvent) => {
          event.preventDefault();
          void submit();
        }}
      >
        <label htmlFor={id}>Token</label>
        <input
          id={id}
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
    </>
  );
}
