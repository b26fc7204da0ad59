/** The sign-in form, shown in place of every page while a token is required. */

import type { JSX } from "react";

import { Icon } from "../shared/ui/icons";
import { SignInForm } from "../shared/ui/SignInForm";

export function SignIn(): JSX.Element {
  return (
    <section className="panel sign-in" aria-labelledby="sign-in">
      <h1 id="sign-in">
        <Icon name="key" /> This service requires a token
      </h1>
      <SignInForm />
      <p className="dim">
        The previous token was revoked or has expired. Create another on the machine of the service with{" "}
        <code>spiked token create NAME</code>. Running captures continue.
      </p>
    </section>
  );
}
