/** Forms in which intrinsics are written as text, as in a source. */

import type { Intrinsics, OptionSchema, OptionValues } from "../api/types";
import { lensOfText, textOfLens } from "./lensText";

/** The schema with intrinsics as text. */
export function withLensText(schema: OptionSchema): OptionSchema {
  const properties = { ...schema.properties };
  const hint = `${properties.intrinsics?.description ?? ""} \`fx,fy,cx,cy\`, and the coefficients of the lens after it.`;
  properties.intrinsics = { anyOf: [{ type: "string" }, { type: "null" }], default: null, description: hint };
  return { ...schema, properties };
}

export const lensAsText = (values: OptionValues): OptionValues =>
  values.intrinsics == null ? values : { ...values, intrinsics: textOfLens(values.intrinsics as Intrinsics) };

/** The reverse. Throws an Error for intrinsics that cannot be read. */
export const textAsLens = (values: OptionValues): OptionValues =>
  typeof values.intrinsics === "string" ? { ...values, intrinsics: lensOfText(values.intrinsics) } : values;
