/** Saves the scene as a picture, as it is shown or of another size. */

import { type JSX, useState } from "react";

import { Icon } from "../../shared/ui/icons";

export interface Size {
  width: number;
  height: number;
}

const LARGEST = 8192;
const SIZES: readonly Size[] = [
  { width: 1920, height: 1080 },
  { width: 3840, height: 2160 },
];
const nameOf = ({ width, height }: Size): string => `${width} × ${height}`;

export function ScreenshotTool({ onScreenshot }: { onScreenshot: (size: Size | null) => void }): JSX.Element {
  const [chosen, setChosen] = useState("shown");
  const [own, setOwn] = useState<Size>({ width: 2400, height: 1600 });
  const size = chosen === "shown" ? null : (SIZES.find((one) => nameOf(one) === chosen) ?? own);
  return (
    <section aria-label="Screenshot">
      <div className="row">
        <button type="button" onClick={() => onScreenshot(size)}>
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
                min={16}
                max={LARGEST}
                value={own[side]}
                onChange={(event) => {
                  const typed = Math.round(event.target.valueAsNumber);
                  if (typed > 0) setOwn({ ...own, [side]: Math.min(typed, LARGEST) });
                }}
              />
            </label>
          ))}
        </div>
      )}
    </section>
  );
}
