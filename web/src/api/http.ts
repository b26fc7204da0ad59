/** Requests to the service, and its errors (RFC 9457). */

export const API = "api/v1";

/** What the service refused or could not do, in its own words. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    message: string,
    readonly whatToDo: string | null = null,
  ) {
    super(message);
    this.name = "ApiError";
  }
}

/** The service did not answer at all. */
export class UnreachableError extends Error {
  constructor() {
    super("The service does not answer.");
    this.name = "UnreachableError";
  }
}

export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(`${API}/${path}`, init);
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new UnreachableError();
  }
  if (response.ok || response.status === 304) return response;
  throw await problemOf(response);
}

async function problemOf(response: Response): Promise<ApiError> {
  try {
    const problem = (await response.json()) as { detail?: string; title?: string; what_to_do?: string | null };
    return new ApiError(
      response.status,
      problem.detail ?? problem.title ?? response.statusText,
      problem.what_to_do ?? null,
    );
  } catch {
    return new ApiError(response.status, `${response.status} ${response.statusText}`);
  }
}

export async function getJson<T>(path: string, init?: RequestInit): Promise<T> {
  return (await (await request(path, init)).json()) as T;
}

export async function sendJson<T>(
  method: string,
  path: string,
  body: unknown,
  headers: Record<string, string> = {},
): Promise<T> {
  const response = await request(path, {
    method,
    headers: { "Content-Type": "application/json", ...headers },
    body: JSON.stringify(body),
  });
  return (response.status === 204 ? undefined : await response.json()) as T;
}

export const query = (values: Record<string, string | number | boolean | null | undefined>): string => {
  const pairs = Object.entries(values).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return pairs.length === 0
    ? ""
    : `?${new URLSearchParams(pairs.map(([key, value]) => [key, String(value)])).toString()}`;
};
