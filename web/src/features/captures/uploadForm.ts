/** The fields of the upload form, what a sidecar says of them, and what they say of the size of the file. */

import type { OptionField, OptionSchema, OptionValues, UploadRequest } from "../../shared/api/types";
import { lensOfText } from "../../shared/state/lensText";

type Geometry = NonNullable<UploadRequest["geometry"]>;

/** Fields of the camera, in the order of the form. */
const CAMERA = ["width", "height", "rate", "mosaic", "flipped", "bit_order", "layout", "response", "fov", "intrinsics"];
const FILE = ["form", "array"];
const ARRAYS = /\.(npy|npz|h5|hdf5)$/;
const TEXT = { anyOf: [{ type: "string" }, { type: "null" }], default: null };
/** Names of the sidecar for fields of the form. */
const SIDECAR: Record<string, string> = { rate: "frame_rate", layout: "format" };

/** Camera and form of the file as one flat schema; intrinsics are written as text. */
export function uploadFields(schema: OptionSchema): OptionSchema {
  const geometry = schema.properties?.["geometry"] as (OptionField & OptionSchema) | undefined;
  const camera = (geometry?.anyOf ?? []).map((one) => one as OptionSchema).find((one) => one.properties !== undefined);
  const known = camera?.properties ?? {};
  const fields = CAMERA.filter((name) => name in known).map((name): [string, OptionField] => [
    name,
    name === "intrinsics"
      ? { ...TEXT, description: "`fx,fy,cx,cy` in pixels, instead of a field of view." }
      : (known[name] ?? {}),
  ]);
  const file = FILE.map((name): [string, OptionField] => [name, schema.properties?.[name] ?? {}]);
  return { properties: Object.fromEntries([...fields, ...file]) };
}

/** What a sidecar states, as values of the form. */
export function valuesOfSidecar(sidecar: Record<string, unknown>): OptionValues {
  const values: OptionValues = {};
  for (const name of CAMERA) {
    const value = sidecar[SIDECAR[name] ?? name];
    if (["string", "number", "boolean"].includes(typeof value)) values[name] = value;
  }
  return values;
}

/** Camera and form of the request. Throws an Error for intrinsics that cannot be read. */
export function statedOf(values: OptionValues): Pick<UploadRequest, "geometry" | "form" | "array"> {
  const stated = Object.entries(values).filter(([name, value]) => value !== null && !FILE.includes(name));
  const { intrinsics, ...others } = Object.fromEntries(stated);
  const lens = typeof intrinsics === "string" ? { intrinsics: lensOfText(intrinsics) } : {};
  const geometry = { ...others, ...lens } as Geometry;
  return {
    geometry: Object.keys(geometry).length === 0 ? null : geometry,
    form: (values["form"] ?? null) as NonNullable<UploadRequest["form"]> | null,
    array: (values["array"] ?? null) as string | null,
  };
}

/** What the size of a file says of the geometry that is stated; null where it says nothing. */
export function sizeText(name: string, bytes: number, values: OptionValues): { text: string; fits: boolean } | null {
  const { width, height, rate, layout, form } = values;
  const stored = form == null || form === "compact" || form === "row_tagged";
  if (!stored || ARRAYS.test(name)) return null;
  if (typeof width !== "number" || typeof height !== "number" || width <= 0 || height <= 0) return null;
  if (width % 8 !== 0) return { text: "The width is not a multiple of 8.", fits: false };
  const frame = (width / 8 + (layout === "row_tagged" ? 2 : 0)) * height;
  const frames = bytes / frame;
  if (!Number.isInteger(frames)) {
    const whole = Math.floor(frames).toLocaleString("en");
    return { text: `${whole} frames of ${frame} bytes and a part of one: size or layout are others.`, fits: false };
  }
  const seconds = typeof rate === "number" && rate > 0 ? `, ${(frames / rate).toPrecision(4)} s` : "";
  return {
    text: `${frames.toLocaleString("en")} frames of ${frame.toLocaleString("en")} bytes${seconds}.`,
    fits: true,
  };
}
