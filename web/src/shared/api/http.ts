/** Requests to the service, typed by its OpenAPI schema, and its errors (RFC 9457). */

import createClient from "openapi-fetch";

import type { paths } from "./schema";

export const API = "api/v1";

/** An error answer of the service. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    message: string,
    readonly whatToDo: string | null = null,
    /** What kind of problem it is, as the service names it. */
    readonly kind = "",
  ) {
    super(message);
    this.name = "ApiError";
  }
}

/** No answer from the service. */
export class UnreachableError extends Error {
  constructor() {
    super("The service does not answer.");
    this.name = "UnreachableError";
  }
}

/** Called when the service answers 401. */
let refused: () => void = () => undefined;
export const onUnauthorized = (listener: () => void): void => {
  refused = listener;
};

/** `fetch` for all requests: throws UnreachableError if there is no answer. */
export async function reach(input: RequestInfo | URL, init?: RequestInit): Promise<Response> {
  try {
    const response = await fetch(input, init);
    if (response.status === 401) refused();
    return response;
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new UnreachableError();
  }
}

/** The page may be served below a prefix: URLs are relative to it. */
const baseUrl = new URL(".", document.baseURI).href.replace(/\/$/, "");
export const client = createClient<paths>({ baseUrl, fetch: reach });

/** Data of a call; throws ApiError. */
export async function answered<T>(call: Promise<{ data?: T; error?: unknown; response: Response }>): Promise<T> {
  const { data, error, response } = await call;
  if (response.ok) return data as T;
  throw errorOf(response, error);
}

/** A request for something that is not JSON. */
export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  const response = await reach(`${API}/${path}`, init);
  if (response.ok) return response;
  throw errorOf(response, await response.json().catch(() => null));
}

/** Sign in with a token, kept in a cookie; false if the token is not valid. */
export async function signIn(token: string): Promise<boolean> {
  try {
    // The redirect after a valid token leads to this page, so it is not followed.
    const init: RequestInit = { method: "POST", body: new URLSearchParams({ token }), redirect: "manual" };
    return (await fetch("sign-in", init)).type === "opaqueredirect";
  } catch {
    throw new UnreachableError();
  }
}

function errorOf(response: Response, body: unknown): ApiError {
  const problem = typeof body === "object" && body !== null ? (body as Record<string, unknown>) : {};
  const text = (key: string): string | null => (typeof problem[key] === "string" ? problem[key] : null);
  const said = text("detail") ?? text("title") ?? `${response.status} ${response.statusText}`;
  const kind = text("type")?.split(":").at(-1);
  return new ApiError(response.status, said, text("what_to_do"), kind);
}

export const query = (values: Record<string, string | number | boolean | null | undefined>): string => {
  const pairs = Object.entries(values).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return pairs.length === 0
    ? ""
    : `?${new URLSearchParams(pairs.map(([key, value]) => [key, String(value)])).toString()}`;
};
