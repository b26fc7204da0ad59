/** A region of the picture, drawn or typed, and its rates. */

import { type JSX, type PointerEvent, useRef } from "react";

import type { Sensor, Stats } from "../../shared/api/types";
import { count, rate } from "../../shared/state/format";
import { PixelProbe } from "./PixelProbe";
import { dragged, isPixel, type Region, within } from "./region";

const SIDES = [
  ["x", "Left"],
  ["y", "Top"],
  ["width", "Width"],
  ["height", "Height"],
] as const;

/** Over the picture: drag for a region, click for a pixel. */
export function RegionOverlay({
  sensor,
  region,
  onRegion,
}: {
  sensor: Sensor;
  region: Region | null;
  onRegion: (region: Region) => void;
}): JSX.Element {
  const from = useRef<[number, number] | null>(null);
  const place = (event: PointerEvent<SVGSVGElement>): [number, number] => {
    const matrix = event.currentTarget.getScreenCTM();
    if (matrix === null) return [0, 0];
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix.inverse());
    return [at.x, at.y];
  };
  const draw = (event: PointerEvent<SVGSVGElement>): void => {
    if (from.current !== null) onRegion(dragged(from.current, place(event), sensor));
  };
  return (
    <svg
      className="marks region"
      viewBox={`0 0 ${sensor.width} ${sensor.height}`}
      aria-hidden="true"
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        from.current = place(event);
      }}
      onPointerMove={draw}
      onPointerUp={(event) => {
        draw(event);
        from.current = null;
      }}
      onPointerCancel={() => (from.current = null)}
    >
      {region !== null && <rect x={region.x} y={region.y} width={region.width} height={region.height} />}
    </svg>
  );
}

/** Its numbers, and what the camera measures there. */
export function RegionPanel({
  capture,
  sensor,
  region,
  stats,
  over,
  frame,
  onRegion,
}: {
  capture: string;
  sensor: Sensor;
  region: Region | null;
  stats: Stats | null;
  over: boolean;
  /** That is shown. */
  frame: number | null;
  onRegion: (region: Region | null) => void;
}): JSX.Element {
  if (region === null)
    return (
      <p className="region-hint dim">
        Drag over the picture for a region, click for a pixel, or{" "}
        <button
          type="button"
          onClick={() =>
            onRegion(
              within(
                { x: sensor.width / 4, y: sensor.height / 4, width: sensor.width / 2, height: sensor.height / 2 },
                sensor,
              ),
            )
          }
        >
          take the middle
        </button>
        .
      </p>
    );
  return (
    <section className="region-panel" aria-label="Region of interest">
      <div className="row">
        {SIDES.map(([side, label]) => (
          <label key={side}>
            {label}
            <input
              type="number"
              min={side === "x" || side === "y" ? 0 : 1}
              max={side === "x" || side === "width" ? sensor.width : sensor.height}
              value={region[side]}
              onChange={(event) => {
                const typed = event.target.valueAsNumber;
                if (Number.isFinite(typed)) onRegion(within({ ...region, [side]: typed }, sensor));
              }}
            />
          </label>
        ))}
        <button type="button" onClick={() => onRegion(null)}>
          All pixels
        </button>
      </div>
      {stats !== null && (
        <p>
          {isPixel(region) ? "This pixel" : `${count(region.width * region.height)} pixels`}:{" "}
          <b>{stats.mean_rate.toFixed(3)} a frame</b>, {rate(stats.mean_rate * sensor.frame_rate_hz)}
          {!isPixel(region) && `, deviation ${stats.deviation.toFixed(3)}`}
          <span className="dim"> over {count(stats.frames)} frames</span>
        </p>
      )}
      {isPixel(region) &&
        (over ? (
          <PixelProbe capture={capture} x={region.x} y={region.y} frame={frame} rateHz={sensor.frame_rate_hz} />
        ) : (
          <p className="dim">Its spikes over time and its depth are shown when the capture has ended.</p>
        ))}
    </section>
  );
}
