/** Calls of the REST API made by the page. */

import { answered, API, ApiError, client, query, request } from "./http";
import type {
  BaselineScale,
  BaselineScaleRequest,
  BoardScale,
  BoardScaleRequest,
  Calibrated,
  Capture,
  CaptureChange,
  CapturePage,
  CaptureRequest,
  CaptureSort,
  CleanRequest,
  ExportFormat,
  Device,
  Edited,
  Finding,
  Grade,
  OptionSchema,
  OptionValues,
  PathOf,
  PreviewKind,
  Profile,
  Reconstruction,
  ReconstructionChange,
  ReconstructionPage,
  RevertRequest,
  Scale,
  ScaleRequest,
  NewToken,
  Reloaded,
  Settings,
  SourceKind,
  ScenePoint,
  Spikes,
  Stats,
  System,
  TagScale,
  TagScaleRequest,
  Timeline,
  Token,
  TokenRequest,
  Trajectory,
  UpRequest,
  Upload,
  UploadRequest,
  Version,
} from "./types";

/** `crypto.randomUUID` exists only in secure contexts; a phone on the local network has none. */
const newKey = (): string =>
  Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
const idempotent = (): { "idempotency-key": string } => ({ "idempotency-key": newKey() });
const ofCapture = (capture_id: string) => ({ params: { path: { capture_id } } });
const ofDevice = (device_id: string) => ({ params: { path: { device_id } } });
const ofReconstruction = (reconstruction_id: string) => ({ params: { path: { reconstruction_id } } });

export const devices = async (): Promise<Device[]> => (await answered(client.GET("/api/v1/devices"))).items;
export const doctor = async (): Promise<Finding[]> =>
  ((await (await request("doctor")).json()) as { items: Finding[] }).items;
export const system = (): Promise<System> => answered(client.GET("/api/v1/system"));
export const configuration = (): Promise<Settings> => answered(client.GET("/api/v1/configuration"));
export const reloadConfiguration = (): Promise<Reloaded> => answered(client.POST("/api/v1/configuration:reload"));
/** null removes a setting from the file: its default. */
export const changeConfiguration = (values: OptionValues): Promise<Reloaded> =>
  answered(client.PATCH("/api/v1/configuration", { body: { values: values as Record<string, null> } }));
export const createToken = (body: TokenRequest): Promise<NewToken> => answered(client.POST("/api/v1/tokens", { body }));
export const revokeToken = (name: string): Promise<unknown> =>
  answered(client.DELETE("/api/v1/tokens/{name}", { params: { path: { name } } }));
export const tokens = async (): Promise<Token[]> => (await answered(client.GET("/api/v1/tokens"))).items;
export const optionSchema = async (): Promise<OptionSchema> => await answered(client.GET("/api/v1/options"));
export const sourceKinds = async (): Promise<SourceKind[]> =>
  (await answered(client.GET("/api/v1/options/sources"))).items;
export const profileSchema = async (): Promise<OptionSchema> => await answered(client.GET("/api/v1/options/profile"));

/** The profile of a device; null if it has none. */
export const profile = async (device: string): Promise<{ profile: Profile | null }> => {
  try {
    return await answered(client.GET("/api/v1/devices/{device_id}/profile", ofDevice(device)));
  } catch (error) {
    if (error instanceof ApiError && error.status === 404) return { profile: null };
    throw error;
  }
};
export const setProfile = async (device: string, body: Profile): Promise<unknown> =>
  await answered(client.PUT("/api/v1/devices/{device_id}/profile", { ...ofDevice(device), body }));
export const removeProfile = (device: string): Promise<unknown> =>
  answered(client.DELETE("/api/v1/devices/{device_id}/profile", ofDevice(device)));
/** Measure a camera by captures in the dark and of an even light. */
export const calibrate = (device_id: string, body: { dark: string | null; flat: string | null }): Promise<Calibrated> =>
  answered(
    client.POST("/api/v1/devices/{device_id}/profile:calibrate", {
      body,
      params: { path: { device_id }, header: idempotent() },
    }),
  );

/** What an upload can state of its file and of the camera. */
export const uploadSchema = async (): Promise<OptionSchema> => await answered(client.GET("/api/v1/options/upload"));
export const createUpload = (body: UploadRequest): Promise<Upload> =>
  answered(client.POST("/api/v1/uploads", { body, params: { header: idempotent() } }));
/** Those that have not become captures, newest first. */
export const uploads = async (): Promise<Upload[]> => (await answered(client.GET("/api/v1/uploads"))).items;
export const upload = (upload_id: string): Promise<Upload> =>
  answered(client.GET("/api/v1/uploads/{upload_id}", { params: { path: { upload_id } } }));
export const removeUpload = (upload_id: string): Promise<unknown> =>
  answered(client.DELETE("/api/v1/uploads/{upload_id}", { params: { path: { upload_id } } }));
/** Send the next bytes; answers how far the upload is. */
export const sendChunk = async (id: string, offset: number, chunk: Blob, signal: AbortSignal): Promise<Upload> => {
  const headers = { "Upload-Offset": String(offset), "Content-Type": "application/octet-stream" };
  return (await (await request(`uploads/${id}`, { method: "PATCH", body: chunk, headers, signal })).json()) as Upload;
};
/** Send the camera's calibration. */
export const sendCalibration = (id: string, file: Blob): Promise<unknown> =>
  request(`uploads/${id}/calibration`, {
    method: "PUT",
    body: file,
    headers: { "Content-Type": "application/octet-stream" },
  });
/** Make a capture of a whole upload; its check takes a while. */
export const completeUpload = (upload_id: string): Promise<Capture> =>
  answered(
    client.POST("/api/v1/uploads/{upload_id}:complete", {
      params: { path: { upload_id }, header: idempotent() },
    }),
  );

export const captures = (wanted: {
  limit?: number;
  cursor?: string;
  q?: string;
  deleted?: boolean;
  keep?: boolean;
  grade?: Grade;
  sort?: CaptureSort;
  descending?: boolean;
}): Promise<CapturePage> => answered(client.GET("/api/v1/captures", { params: { query: wanted } }));
export const capture = (id: string): Promise<Capture> =>
  answered(client.GET("/api/v1/captures/{capture_id}", ofCapture(id)));
export const startCapture = (plan: CaptureRequest): Promise<Capture> =>
  answered(client.POST("/api/v1/captures", { body: plan, params: { header: idempotent() } }));
export const stopCapture = (id: string): Promise<Capture> =>
  answered(client.POST("/api/v1/captures/{capture_id}:stop", ofCapture(id)));
export const changeCapture = (id: string, change: CaptureChange): Promise<Capture> =>
  answered(client.PATCH("/api/v1/captures/{capture_id}", { ...ofCapture(id), body: change }));
export const removeCapture = (id: string): Promise<unknown> =>
  answered(client.DELETE("/api/v1/captures/{capture_id}", ofCapture(id)));
export const restoreCapture = (id: string): Promise<Capture> =>
  answered(client.POST("/api/v1/captures/{capture_id}:restore", ofCapture(id)));
export const purgeCapture = (id: string): Promise<unknown> =>
  answered(client.POST("/api/v1/captures/{capture_id}:purge", ofCapture(id)));
/** Over all pixels, or a region of the picture; of the newest frames, of a recording those around `frame`. */
export const stats = (
  id: string,
  region: { x: number; y: number; width: number; height: number } | null = null,
  frame: number | null = null,
): Promise<Stats> =>
  answered(
    client.GET("/api/v1/captures/{capture_id}/stats", {
      params: { path: { capture_id: id }, query: { ...region, frame } },
    }),
  );
/** When a pixel fired around a frame. */
export const spikes = (id: string, x: number, y: number, frame: number): Promise<Spikes> =>
  answered(
    client.GET("/api/v1/captures/{capture_id}/spikes", {
      params: { path: { capture_id: id }, query: { x, y, frame } },
    }),
  );
/** What the scene of the newest reconstruction has at a pixel of a frame. */
export const point = (id: string, x: number, y: number, frame: number): Promise<ScenePoint> =>
  answered(
    client.GET("/api/v1/captures/{capture_id}/point", {
      params: { path: { capture_id: id }, query: { x, y, frame } },
    }),
  );

export const reconstruction = (id: string): Promise<Reconstruction> =>
  answered(client.GET("/api/v1/reconstructions/{reconstruction_id}", ofReconstruction(id)));
/** The newest ones of a capture, or those before the one with this id. */
export const reconstructions = async (captureId: string, before: string | null = null): Promise<Reconstruction[]> =>
  (
    await answered(
      client.GET("/api/v1/reconstructions", {
        params: { query: { capture_id: captureId, limit: 100, cursor: before } },
      }),
    )
  ).items;
/** Of each of at most a hundred captures the one whose scene is shown. */
export const shownOf = async (captureIds: string[]): Promise<Reconstruction[]> =>
  (await answered(client.GET("/api/v1/reconstructions", { params: { query: { shown_of: captureIds } } }))).items;
const queue = (limit: number): Promise<ReconstructionPage> =>
  answered(client.GET("/api/v1/reconstructions", { params: { query: { in_turn: true, limit } } }));
/** Running reconstructions of all captures, the next ones of the queue, and the length of the queue. */
export const unfinished = async (next: number): Promise<{ jobs: Reconstruction[]; queued: number }> => {
  const [running, waiting] = await Promise.all([
    answered(client.GET("/api/v1/reconstructions", { params: { query: { state: "running", limit: 100 } } })),
    queue(next),
  ]);
  return { jobs: [...running.items, ...waiting.items], queued: waiting.total ?? waiting.items.length };
};
export const queueLength = async (): Promise<number> => (await queue(1)).total ?? 0;
/** The newest complete reconstructions of all captures. */
export const complete = async (): Promise<Reconstruction[]> =>
  (await answered(client.GET("/api/v1/reconstructions", { params: { query: { state: "complete", limit: 200 } } })))
    .items;
/** What is not estimated, and not taken from the recording. */
export type Given = Partial<Record<"poses" | "poses_of" | "calibration_of", string | null>>;
/** With `map`, the map of that reconstruction is extended. */
export const submit = (
  captureId: string,
  options: OptionValues,
  map: string | null = null,
  given: Given = {},
): Promise<Reconstruction> =>
  answered(
    client.POST("/api/v1/reconstructions", {
      body: { capture_id: captureId, options, map, ...given },
      params: { header: idempotent() },
    }),
  );
export const localise = (map: string, captureId: string): Promise<Reconstruction> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}:localise", {
      body: { capture_id: captureId },
      params: { path: { reconstruction_id: map }, header: idempotent() },
    }),
  );
export const merge = (first: string, other: string): Promise<Reconstruction> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}:merge", {
      body: { other },
      params: { path: { reconstruction_id: first }, header: idempotent() },
    }),
  );
/** Change its name or notes, or hold or move it in the queue. */
export const changeReconstruction = (id: string, body: ReconstructionChange): Promise<Reconstruction> =>
  answered(
    client.PATCH("/api/v1/reconstructions/{reconstruction_id}", {
      body,
      params: { path: { reconstruction_id: id } },
    }),
  );
export const removeReconstruction = (id: string): Promise<unknown> =>
  answered(client.DELETE("/api/v1/reconstructions/{reconstruction_id}", ofReconstruction(id)));
export const cancel = (id: string): Promise<Reconstruction> =>
  answered(client.POST("/api/v1/reconstructions/{reconstruction_id}:cancel", ofReconstruction(id)));
/** At most `points` neighbouring moments joined, of a part of the time. */
export const timeline = (id: string, asked: { points: number; from_s?: number; to_s?: number }): Promise<Timeline> =>
  answered(
    client.GET("/api/v1/reconstructions/{reconstruction_id}/timeline", {
      params: { path: { reconstruction_id: id }, query: asked },
    }),
  );
/** Kept versions, oldest first. */
export const versions = async (id: string): Promise<Version[]> =>
  (await answered(client.GET("/api/v1/reconstructions/{reconstruction_id}/versions", ofReconstruction(id)))).items;
/** Every `step`-th pose of a version, the newest if none is named. */
export const trajectory = async (id: string, step: number, version?: number): Promise<Trajectory> =>
  (await (
    await request(`reconstructions/${id}/trajectory${query({ format: "json", step, version })}`)
  ).json()) as Trajectory;
export const log = async (id: string): Promise<string> => (await request(`reconstructions/${id}/log`)).text();

/** The formats of other programs. */
export const exportFormats = async (): Promise<ExportFormat[]> =>
  (await answered(client.GET("/api/v1/exports"))).formats;

/** Metres for the unit of a scene, and which way is up. */
export const scale = (id: string): Promise<Scale> =>
  answered(client.GET("/api/v1/reconstructions/{reconstruction_id}/scale", ofReconstruction(id)));
export const setScale = (id: string, body: ScaleRequest): Promise<Scale> =>
  answered(client.PUT("/api/v1/reconstructions/{reconstruction_id}/scale", { ...ofReconstruction(id), body }));
export const scaleByTag = (id: string, body: TagScaleRequest): Promise<TagScale> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}/scale:tag", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );
export const scaleByBoard = (id: string, body: BoardScaleRequest): Promise<BoardScale> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}/scale:board", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );
export const scaleByBaseline = (id: string, body: BaselineScaleRequest): Promise<BaselineScale> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}/scale:baseline", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );
/** By gravity, or by the floor, which is found. */
export const findUp = (id: string, body: UpRequest): Promise<Scale> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}/scale:up", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );
/** The paths of all recordings through the scene, its own first. */
export const paths = async (id: string): Promise<PathOf[]> =>
  (await answered(client.GET("/api/v1/reconstructions/{reconstruction_id}/paths", ofReconstruction(id)))).items;

/** Publish a version without floaters, or without what is outside of a box. */
export const clean = (id: string, body: CleanRequest): Promise<Edited> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}:clean", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );
/** Publish an earlier version again. */
export const revert = (id: string, body: RevertRequest): Promise<Edited> =>
  answered(
    client.POST("/api/v1/reconstructions/{reconstruction_id}:revert", {
      body,
      params: { path: { reconstruction_id: id }, header: idempotent() },
    }),
  );

type Asked<Name extends string> = Record<Name, string | number | boolean | null>;

/** URLs for elements that fetch by themselves. */
export const address = {
  thumbnail: (id: string): string => `${API}/captures/${id}/thumbnail`,
  preview: (
    id: string,
    kind: PreviewKind,
    extra: {
      gain?: number | undefined;
      frame?: number | undefined;
      white?: number | undefined;
      undistorted?: boolean;
      optics_of?: string;
      optics_version?: number | undefined;
    } = {},
  ): string => `${API}/captures/${id}/preview${query({ kind, ...extra })}`,
  /** A picture of what is known of each pixel; `file` makes it another one after a new calibration. */
  calibration: (device: string, kind: string, file: string): string =>
    `${API}/devices/${encodeURIComponent(device)}/profile/calibration${query({ kind, file })}`,
  recording: (id: string): string => `${API}/captures/${id}/recording`,
  sidecar: (id: string): string => `${API}/captures/${id}/recording/sidecar`,
  /** Of the newest version unless another is named. */
  scene: (id: string, format: "ply" | "spz", version?: number): string =>
    `${API}/reconstructions/${id}/scene${query({ format, version })}`,
  changes: (id: string, asked: { level: number; version?: number | undefined; since?: string | undefined }): string =>
    `${API}/reconstructions/${id}/scene/changes${query(asked)}`,
  report: (id: string): string => `${API}/reconstructions/${id}/report`,
  exported: (id: string, format: string, metric: boolean): string =>
    `${API}/reconstructions/${id}/exports/${format}${query(metric ? { metric } : {})}`,
  /** An MP4 along the path, or through poses if there are any: x, y, z, qw, qx, qy, qz of each. */
  video: (
    id: string,
    {
      through,
      ...asked
    }: Asked<"version" | "seconds" | "fps" | "width" | "height" | "along"> & {
      through: readonly (readonly number[])[];
    },
  ): string =>
    `${API}/reconstructions/${id}/exports/video${query({
      ...asked,
      through: through.map((pose) => pose.map((value) => value.toFixed(6)).join(",")).join(";"),
    })}`,
  /** An MP4 of a recording in slow motion. */
  slowMotion: (id: string, asked: Asked<"slower" | "fps" | "window" | "compensate">): string =>
    `${API}/captures/${id}/recording/video${query(asked)}`,
  bundle: (id: string): string => `${API}/reconstructions/${id}/bundle`,
  trajectory: (id: string, format: string): string => `${API}/reconstructions/${id}/trajectory${query({ format })}`,
};

/** Have the service make a file, which it then keeps for a while: one byte of it is fetched. Throws ApiError. */
export const made = async (url: string): Promise<void> => {
  await (await request(url.slice(API.length + 1), { headers: { Range: "bytes=0-0" } })).arrayBuffer();
};

/** The bytes of a picture or a scene, aborted by `signal`. */
export const fetched = (url: string, signal: AbortSignal): Promise<Response> =>
  request(url.slice(API.length + 1), { signal });
