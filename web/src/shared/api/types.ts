/** Names for the types generated from the OpenAPI schema, and the events of the WebSocket. */

import type { components } from "./schema";

type Schemas = components["schemas"];

export type DeviceState = Schemas["DeviceState"];
export type CaptureState = Schemas["CaptureState"];
export type Grade = Schemas["Grade"];
export type Stage = Schemas["Stage"];
export type Task = Schemas["Task"];
export type TrackingState = Schemas["State"];
export type JobState = Schemas["JobState"];
export type PreviewKind = Schemas["PictureKind"];

export type Counters = Schemas["CountersOut"];
export type Device = Schemas["DeviceOut"];
export type Intrinsics = Schemas["IntrinsicsModel"];
export type Profile = Schemas["ProfileModel"];
export type Calibrated = Schemas["CalibratedOut"];
export type SourceKind = Schemas["SourceKindOut"];
export type Sensor = Schemas["SensorOut"];
export type Capture = Schemas["CaptureOut"];
export type CaptureSort = Schemas["CaptureSort"];
export type CapturePage = Schemas["CapturePage"];
export type CaptureRequest = Schemas["CaptureRequest"];
export type CaptureChange = Schemas["CaptureChange"];
export type Upload = Schemas["UploadOut"];
/** Without the field of a profile that is always null, which openapi-fetch takes for one that cannot be sent. */
export type UploadRequest = Omit<Schemas["UploadRequest"], "profile"> & {
  profile?: Omit<Schemas["UploadProfile"], "calibration"> | null;
};
export type Reconstruction = Schemas["ReconstructionOut"];
export type ReconstructionPage = Schemas["ReconstructionPage"];
export type ReconstructionChange = Schemas["ReconstructionChange"];
export type Scale = Schemas["ScaleOut"];
export type ScaleRequest = Schemas["ScaleRequest"];
export type TagScale = Schemas["TagScaleOut"];
export type TagScaleRequest = Schemas["TagScaleRequest"];
export type BoardScale = Schemas["BoardScaleOut"];
export type BoardScaleRequest = Schemas["BoardScaleRequest"];
export type BaselineScale = Schemas["BaselineScaleOut"];
export type BaselineScaleRequest = Schemas["BaselineScaleRequest"];
export type UpRequest = Schemas["UpRequest"];
export type PathOf = Schemas["PathOut"];
export type ExportFormat = Schemas["ExportFormatOut"];
export type CleanRequest = Schemas["CleanRequest"];
export type RevertRequest = Schemas["RevertRequest"];
export type Edited = Schemas["EditedOut"];
export type OptionValues = Record<string, unknown>;
export type Version = Schemas["VersionOut"];
export type Trajectory = Schemas["TrajectoryOut"];
export type RateHistogram = Schemas["RateHistogram"];
/** Pixels as [x, y]; the generated client forgets that pairs have two numbers. */
export type Stats = Omit<Schemas["StatsOut"], "hot_pixels"> & { hot_pixels: number[][] };
export type ScenePoint = Schemas["PointOut"];
export type Spikes = Schemas["SpikesOut"];
export type Gap = Schemas["GapOut"];
export type Closure = Schemas["ClosureOut"];
export type Timeline = Schemas["TimelineOut"];
export type System = Schemas["SystemOut"];
export type Setting = Schemas["SettingOut"];
export type Reloaded = Schemas["ReloadedOut"];
export type Settings = Schemas["SettingsOut"];
export type NewToken = Schemas["NewTokenOut"];
export type TokenRequest = Schemas["TokenRequest"];
export type Token = Schemas["TokenOut"];
export type Scope = Schemas["Scope"];

export interface Finding {
  name: string;
  status: "ok" | "warning" | "problem";
  finding: string;
  what_to_do: string | null;
}

/** A tracked block of frames; camera to world, OpenCV axes. */
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

export interface Preview {
  frame: number;
  kind: "interval" | "rate";
  width: number;
  height: number;
  /** WebP, base64. */
  image: string;
  rate_histogram?: number[] | null;
}

export interface SceneEvent {
  version: number;
  splats: number;
  psnr_db?: number | null;
  bytes?: number;
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
  | Envelope<"scene", SceneEvent>
  | Envelope<"preview", Preview>
  | Envelope<"log", { level: string; event: string; logger?: string } & Record<string, unknown>>
  | Envelope<"lost", Record<string, unknown>>;
