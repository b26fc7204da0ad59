/** Sides that a scene can be looked at from. */

import { Vector3 } from "three";

export const PRESETS = [
  { value: "camera", label: "Camera", hint: "Where the capture camera is" },
  { value: "front", label: "Front", hint: "As the first pose looks" },
  { value: "left", label: "Left", hint: "From the left of the first pose" },
  { value: "right", label: "Right", hint: "From the right of the first pose" },
  { value: "top", label: "Top", hint: "From above" },
] as const;
export type Preset = (typeof PRESETS)[number]["value"];

/** Not quite from above: a camera that looks along its upward direction has none. */
const ABOVE = new Vector3(0, 1, 0.001);

/** Towards the eye, in the axes of three.js: the first pose looks along -z. */
export function presetDirection(preset: Preset): Vector3 {
  switch (preset) {
    case "left":
      return new Vector3(-1, 0, 0);
    case "right":
      return new Vector3(1, 0, 0);
    case "top":
      return ABOVE.clone().normalize();
    case "front":
    case "camera":
      return new Vector3(0, 0, 1);
  }
}
