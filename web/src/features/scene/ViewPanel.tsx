/** What is shown of the splats, and from where. */

import type { JSX } from "react";

import { MODE_TEXTS, VIEW_MODES, type ViewMode } from "./viewModes";
import { type Preset, PRESETS } from "./presets";

export type Shows = ViewMode | "error";

const ERROR_MEANING = "What the camera saw at the chosen frame against what the scene shows there, four times";
/** Field of view of the free camera, degrees. */
const FOV = { least: 20, most: 110 };

export function ViewPanel({
  shows,
  onShows,
  fov,
  onFov,
  onPreset,
}: {
  shows: Shows;
  onShows: (shows: Shows) => void;
  fov: number;
  onFov: (fov: number) => void;
  onPreset: (preset: Preset) => void;
}): JSX.Element {
  return (
    <section className="view-panel" aria-label="View">
      <label className="row">
        <span className="dim">Show</span>
        <select aria-label="Show" value={shows} onChange={(event) => onShows(event.target.value as Shows)}>
          {VIEW_MODES.map((mode) => (
            <option key={mode} value={mode}>
              {MODE_TEXTS[mode].label}
            </option>
          ))}
          <option value="error">Error against the views</option>
        </select>
      </label>
      {shows !== "colour" && (
        <p className="dim hint">{shows === "error" ? ERROR_MEANING : MODE_TEXTS[shows].meaning}</p>
      )}
      <div className="buttons presets" role="group" aria-label="Look from">
        {PRESETS.map((one) => (
          <button key={one.value} type="button" title={one.hint} onClick={() => onPreset(one.value)}>
            {one.label}
          </button>
        ))}
      </div>
      <label className="row">
        <span className="dim">Field of view</span>
        <input
          type="range"
          min={FOV.least}
          max={FOV.most}
          value={fov}
          aria-valuetext={`${fov} degrees`}
          onChange={(event) => onFov(event.target.valueAsNumber)}
        />
        <span className="number">{fov}°</span>
      </label>
    </section>
  );
}
