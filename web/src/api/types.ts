/** What the service says, by the names of its REST contract. */

export type DeviceState = "absent" | "idle" | "armed" | "streaming" | "lost";
export type CaptureState = "starting" | "streaming" | "finishing" | "complete" | "failed";
export type Grade = "good" | "degraded" | "bad";
export type Stage = "waiting" | "tracking" | "mapping" | "refining" | "done";
export type TrackingState = "boot" | "track" | "degraded" | "lost" | "reloc";
export type JobState = "queued" | "running" | "complete" | "cancelled" | "failed";

export interface Page<T> {
  items: T[];
  next_cursor: string | null;
}

export interface Consumer {
  name: string;
  policy: string;
  received: number;
  lost: number;
  lag_frames: number;
  /** Its lag as a part of what it may lag, 0 to 1. */
  fill: number;
  lagging: boolean;
}

export interface Counters {
  device: DeviceState;
  device_reason: string;
  received: number;
  /** By cause: device, usb, ring, disk. */
  lost: Record<string, number>;
  next_frame: number;
  consumers: Consumer[];
}

export interface Capability {
  supported: boolean;
  value?: unknown;
}

export interface Device {
  id: string;
  kind: string;
  source: string;
  description: string;
  state: DeviceState;
  reason: string | null;
  serial: string | null;
  port: string | null;
  speed: string | null;
  firmware: string | null;
  capabilities: Record<string, Capability>;
  capture_id: string | null;
}

export interface Intrinsics {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

export interface Sensor {
  width: number;
  height: number;
  frame_rate_hz: number;
  intrinsics: Intrinsics | null;
}

export interface Verdict {
  grade: Grade;
  reasons: string[];
}

export interface Capture {
  id: string;
  name: string | null;
  notes: string | null;
  keep: boolean;
  origin: "live" | "upload";
  source: string;
  state: CaptureState;
  reason: string;
  warnings: string[];
  verdict: Verdict | null;
  started_at: string;
  ended_at: string | null;
  frames_planned: number | null;
  deleted_at: string | null;
  recording: { bytes: number; frames: number; sha256?: string | null } | null;
  reconstruction_ids: string[];
  sensor: Sensor | null;
  counters: Counters | null;
}

export type OptionValues = Record<string, unknown>;

export interface Reconstruction {
  id: string;
  capture_id: string;
  live: boolean;
  state: JobState;
  stage: Stage;
  progress: number;
  tracking_state: TrackingState | null;
  reason: string;
  options: OptionValues;
  created_at: string;
  started_at: string | null;
  ended_at: string | null;
  frames: number;
  poses: number;
  splats: number;
  loss: number | null;
  psnr_db: number | null;
  version: number;
  eta_s: number | null;
  white?: number | null;
}

export interface Pose {
  frame: number;
  time_s: number;
  position: [number, number, number];
  quaternion_wxyz: [number, number, number, number];
  state: TrackingState;
  sigma_px?: number | null;
  chi2?: number | null;
  latency_s?: number | null;
}

export interface Trajectory {
  version: number;
  times_s: number[];
  positions: number[][];
  quaternions_wxyz: number[][];
  frames?: number[];
  states?: TrackingState[];
}

export interface RateHistogram {
  edges: number[];
  counts: number[];
}

export interface Stats {
  frame: number;
  rate_histogram: RateHistogram;
  hot_pixels: number[][];
  mean_rate: number;
}

export type PreviewKind = "interval" | "rate" | "accumulation" | "render";

export interface Preview {
  frame: number;
  kind: PreviewKind;
  width: number;
  height: number;
  /** WebP, base64. */
  image: string;
  rate_histogram?: number[] | null;
}

export interface SceneNews {
  version: number;
  splats: number;
  psnr_db?: number | null;
  bytes?: number;
}

export interface Gap {
  first: number;
  count: number;
  cause: string;
}

/** Arrays of the same length; null where a value is not known. */
export interface Timeline {
  time_s: number[];
  frame: number[];
  state: TrackingState[];
  chi2: (number | null)[];
  sigma_px: (number | null)[];
  rate: (number | null)[];
  loss: (number | null)[];
  psnr_db: (number | null)[];
  splats: (number | null)[];
  gaps: Gap[];
}

export interface System {
  version: string;
  started_at: string;
  uptime_s: number;
  data_folder: string;
  disk: { free_bytes: number; total_bytes: number };
  memory_bytes: number;
  pid: number;
  events_seq: number;
}

export interface DoctorItem {
  name: string;
  status: "ok" | "warning" | "problem";
  finding: string;
  what_to_do: string | null;
}

export interface ConfigurationItem {
  key: string;
  value: unknown;
  origin: "default" | "file" | "environment" | "flag";
  reloadable: boolean;
  doc: string;
}

export interface TokenItem {
  name: string;
  [key: string]: unknown;
}

export interface CaptureRequest {
  source?: string;
  device?: string;
  frames?: number;
  seconds?: number;
  name?: string;
  notes?: string;
  record?: boolean;
  reconstruct?: boolean;
  options?: OptionValues;
}

/** A JSON Schema, as far as the options form reads it. */
export interface OptionSchema {
  title?: string;
  description?: string;
  properties?: Record<string, OptionField>;
  $defs?: Record<string, OptionField>;
}

export interface OptionField {
  title?: string;
  description?: string;
  type?: string;
  enum?: unknown[];
  anyOf?: OptionField[];
  $ref?: string;
  default?: unknown;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
  exclusiveMaximum?: number;
}

export type Topic = "device" | "capture" | "job" | "pose" | "scene" | "preview" | "log" | "lost";

interface Envelope<T extends Topic, D> {
  seq: number;
  topic: T;
  at: string;
  capture_id: string | null;
  reconstruction_id: string | null;
  data: D;
}

export type Message =
  | Envelope<"device", Device>
  | Envelope<"capture", Capture>
  | Envelope<"job", Reconstruction>
  | Envelope<"pose", Pose>
  | Envelope<"scene", SceneNews>
  | Envelope<"preview", Preview>
  | Envelope<"log", { level: string; event: string; logger?: string } & Record<string, unknown>>
  | Envelope<"lost", Record<string, unknown>>;
