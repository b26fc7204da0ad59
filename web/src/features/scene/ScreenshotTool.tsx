/** Saves the scene as a picture, as it is shown or of another size. */

import { type JSX, useState } from "react";

import { Icon } from "../../shared/ui/icons";
import type { Size } from "./Viewer";

/** Sides of a picture, pixels. */
const LEAST = 16;
const LARGEST = 8192;
const isSide = (value: number): boolean => Number.isInteger(value) && value >= LEAST && value <= LARGEST;
const SIZES: readonly Size[] = [
  { width: 1920, height: 1080 },
  { width: 3840, height: 2160 },
];
const nameOf = ({ width, height }: Size): string => `${width} × ${height}`;

export function ScreenshotTool({ onScreenshot }: { onScreenshot: (size: Size | null) => void }): JSX.Element {
  const [chosen, setChosen] = useState("shown");
  const [own, setOwn] = useState({ width: "2400", height: "1600" });
  const typed = { width: Number(own.width), height: Number(own.height) };
  const size = chosen === "shown" ? null : (SIZES.find((one) => nameOf(one) === chosen) ?? typed);
  const possible = size === null || (isSide(size.width) && isSide(size.height));
  return (
    <section aria-label="Screenshot">
      <div className="row">
        <button type="button" disabled={!possible} onClick={() => onScreenshot(size)}>
          <Icon name="camera" /> Screenshot
        </button>
        <select aria-label="Size of the screenshot" value={chosen} onChange={(event) => setChosen(event.target.value)}>
          <option value="shown">as shown</option>
          {SIZES.map((one) => (
            <option key={nameOf(one)} value={nameOf(one)}>
              {nameOf(one)}
            </option>
          ))}
          <option value="own">other size</option>
        </select>
      </div>
      {chosen === "own" && (
        <div className="row">
          {(["width", "height"] as const).map((side) => (
            <label key={side}>
              {side === "width" ? "Width" : "Height"}{" "}
              <input
                type="number"
                min={LEAST}
                max={LARGEST}
                value={own[side]}
                onChange={(event) => setOwn({ ...own, [side]: event.target.value })}
              />
            </label>
          ))}
        </div>
      )}
    </section>
  );
}
