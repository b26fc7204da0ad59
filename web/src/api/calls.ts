/** The calls of the service that the page makes. */

import { API, getJson, query, request, sendJson } from "./http";
import type {
  Capture,
  CaptureRequest,
  ConfigurationItem,
  Device,
  DoctorItem,
  OptionSchema,
  OptionValues,
  Page,
  PreviewKind,
  Reconstruction,
  Stats,
  System,
  Timeline,
  TokenItem,
  Trajectory,
} from "./types";

const idempotent = (): Record<string, string> => ({ "Idempotency-Key": newKey() });

/** `crypto.randomUUID` exists only in secure contexts; a phone on the local network has none. */
function newKey(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

export const devices = async (): Promise<Device[]> => (await getJson<Page<Device>>("devices")).items;
export const doctor = async (): Promise<DoctorItem[]> => (await getJson<{ items: DoctorItem[] }>("doctor")).items;
export const system = (): Promise<System> => getJson("system");
export const configuration = async (): Promise<ConfigurationItem[]> =>
  (await getJson<{ items: ConfigurationItem[] }>("configuration")).items;
export const reloadConfiguration = (): Promise<unknown> => sendJson("POST", "configuration:reload", {});
export const tokens = async (): Promise<TokenItem[]> => (await getJson<{ items: TokenItem[] }>("tokens")).items;
export const optionSchema = (): Promise<OptionSchema> => getJson("options");

export const captures = (asked: {
  limit?: number;
  cursor?: string | null;
  q?: string;
  state?: string;
}): Promise<Page<Capture>> => getJson(`captures${query(asked)}`);
export const capture = (id: string): Promise<Capture> => getJson(`captures/${id}`);
export const startCapture = (plan: CaptureRequest): Promise<Capture> =>
  sendJson("POST", "captures", plan, idempotent());
export const stopCapture = (id: string): Promise<Capture> => sendJson("POST", `captures/${id}:stop`, {});
export const renameCapture = (
  id: string,
  change: { name?: string; notes?: string; keep?: boolean },
): Promise<Capture> => sendJson("PATCH", `captures/${id}`, change);
export const removeCapture = (id: string): Promise<Response> => request(`captures/${id}`, { method: "DELETE" });
export const restoreCapture = (id: string): Promise<Capture> => sendJson("POST", `captures/${id}:restore`, {});
export const stats = (id: string, frame?: number): Promise<Stats> => getJson(`captures/${id}/stats${query({ frame })}`);

export const reconstructions = async (captureId: string): Promise<Reconstruction[]> =>
  (await getJson<Page<Reconstruction>>(`reconstructions${query({ capture_id: captureId, limit: 100 })}`)).items;
export const reconstruction = (id: string): Promise<Reconstruction> => getJson(`reconstructions/${id}`);
export const submit = (captureId: string, options: OptionValues): Promise<Reconstruction> =>
  sendJson("POST", "reconstructions", { capture_id: captureId, options }, idempotent());
export const cancel = (id: string): Promise<Reconstruction> => sendJson("POST", `reconstructions/${id}:cancel`, {});
export const timeline = (id: string): Promise<Timeline> => getJson(`reconstructions/${id}/timeline`);
export const trajectory = (id: string): Promise<Trajectory> => getJson(`reconstructions/${id}/trajectory?format=json`);
export const log = async (id: string): Promise<string> => (await request(`reconstructions/${id}/log`)).text();

/** Addresses of what the browser fetches by itself. */
export const address = {
  thumbnail: (id: string): string => `${API}/captures/${id}/thumbnail`,
  preview: (
    id: string,
    kind: PreviewKind,
    extra: { gain?: number | undefined; frame?: number | undefined; white?: number | undefined } = {},
  ): string => `${API}/captures/${id}/preview${query({ kind, ...extra })}`,
  recording: (id: string): string => `${API}/captures/${id}/recording`,
  sidecar: (id: string): string => `${API}/captures/${id}/recording/sidecar`,
  scene: (id: string, format: "ply" | "spz", extra: { version?: number; max_splats?: number } = {}): string =>
    `${API}/reconstructions/${id}/scene${query({ format, ...extra })}`,
  trajectory: (id: string, format: string): string => `${API}/reconstructions/${id}/trajectory${query({ format })}`,
};

/** The bytes of a scene, with the version they are of. Aborted by `signal`. */
export async function sceneBytes(url: string, signal: AbortSignal): Promise<Uint8Array> {
  const response = await request(url.replace(`${API}/`, ""), { signal });
  return new Uint8Array(await response.arrayBuffer());
}
