/** One plot over time; all plots of a page share their cursor. */

import "uplot/dist/uPlot.min.css";

import { type JSX, useEffect, useRef } from "react";
import uPlot from "uplot";

import type { Gap } from "../../shared/api/types";
import { colour, useDark } from "../../shared/state/theme";
import type { Axis, Column } from "./series";

const HEIGHT = 112;
const SYNC = uPlot.sync("captures");
/** uPlot's `Scale.Distr`: a constant enum, which has no values that isolated modules could import. */
const LINEAR = 1;
const LOGARITHMIC = 3;
const LEAST_TICK_PX = 20;
/** Below this number of values, points are drawn as well. */
const FEW = 24;
const DASHES = [[], [6, 4]];

export interface PlotProps {
  title: string;
  unit: string;
  hint: string;
  log: boolean;
  data: [number[], ...Column[]];
  names: readonly string[];
  /** Seconds, begin and end of what is missing. */
  gaps: readonly [number, number][];
  axis: Axis;
}

export const gapSpans = (gaps: readonly Gap[], frameRateHz: number): [number, number][] =>
  gaps.map((gap) => [gap.first / frameRateHz, (gap.first + gap.count) / frameRateHz]);

export function Plot({ title, unit, hint, log, data, names, gaps, axis: over }: PlotProps): JSX.Element {
  const box = useRef<HTMLDivElement>(null);
  const dark = useDark();
  useEffect(() => {
    const element = box.current;
    if (element === null) return;
    const axis = { stroke: colour("dim"), grid: { stroke: colour("line"), width: 1 }, ticks: { show: false } };
    const strokes = [colour("accent"), colour("warning")];
    const plot = new uPlot(
      {
        width: Math.max(element.clientWidth, 50),
        height: HEIGHT,
        cursor: { sync: { key: SYNC.key }, y: false, drag: { x: true, y: false } },
        legend: { live: true },
        // eslint-disable-next-line @typescript-eslint/no-unsafe-enum-assignment -- see LINEAR
        scales: { x: { time: false }, y: { distr: log ? LOGARITHMIC : LINEAR } },
        axes: [
          { ...axis, size: 24, values: (_, ticks) => ticks.map(over === "work" ? seconds : milliseconds) },
          {
            ...axis,
            size: 58,
            space: LEAST_TICK_PX,
            // A logarithmic axis has a line for each power of ten, not for each of its nine parts.
            grid: log ? { ...axis.grid, filter: (_, ticks) => ticks.map((t) => (isPower(t) ? t : null)) } : axis.grid,
            values: (_, ticks) => ticks.map((t) => ((t as number | null) === null ? "" : short(t))),
          },
        ],
        series: [
          {
            label: "t",
            value: (_, t) =>
              (t as number | null) === null
                ? "–"
                : over === "work"
                  ? `${t.toFixed(1)} s`
                  : `${(1000 * t).toFixed(2)} ms`,
          },
          ...names.map((name, i) => ({
            label: name,
            stroke: strokes[i] ?? colour("ink"),
            dash: DASHES[i] ?? [],
            width: 1.4,
            points: { show: known(data[i + 1] ?? []) < FEW, size: 5 },
            spanGaps: names.length > 1,
            value: (_: uPlot, v: number | null) => (v === null ? "–" : `${short(v)} ${unit}`),
          })),
        ],
        hooks: {
          drawClear: [(u) => shade(u, gaps)],
          // The legend of a single line is shown only under the cursor.
          setLegend: [(u) => u.root.classList.toggle("idle", names.length === 1 && (u.legend.idx ?? null) === null)],
        },
      },
      data,
      element,
    );
    SYNC.sub(plot);
    const observer = new ResizeObserver(() =>
      plot.setSize({ width: Math.max(element.clientWidth, 50), height: HEIGHT }),
    );
    observer.observe(element);
    return () => {
      observer.disconnect();
      SYNC.unsub(plot);
      plot.destroy();
    };
  }, [data, names, gaps, log, unit, dark, over]);
  return (
    <figure className="plot">
      <figcaption title={hint}>
        {title} {unit !== "" && <span className="dim">{unit}</span>}
      </figcaption>
      <div
        ref={box}
        role="img"
        aria-label={`${title} over ${over === "work" ? "seconds of work" : "time"}. ${hint}. ${summary(data[1] ?? [], unit)}`}
      />
    </figure>
  );
}

const known = (column: Column): number => column.filter((value) => value !== null).length;
const milliseconds = (t: number): string => `${Number((1000 * t).toPrecision(6))} ms`;
const seconds = (t: number): string => `${Number(t.toPrecision(6))} s`;
const isPower = (x: number): boolean => Math.abs(Math.log10(x) - Math.round(Math.log10(x))) < 1e-6;

const short = (x: number): string =>
  x === 0 ? "0" : Math.abs(x) >= 0.001 && Math.abs(x) < 10_000 ? String(Number(x.toPrecision(3))) : x.toExponential(1);

/** Text alternative of the plot. */
function summary(column: Column, unit: string): string {
  const values = column.filter((value) => value !== null);
  if (values.length === 0) return "No values.";
  const texts = [Math.min(...values), Math.max(...values), values.at(-1) ?? 0].map((x) => `${short(x)} ${unit}`.trim());
  return `From ${texts[0] ?? ""} to ${texts[1] ?? ""}, at the end ${texts[2] ?? ""}.`;
}

function shade(u: uPlot, gaps: readonly [number, number][]): void {
  u.ctx.save();
  u.ctx.fillStyle = colour("problem");
  u.ctx.globalAlpha = 0.35;
  for (const [from, to] of gaps) {
    const left = u.valToPos(from, "x", true);
    u.ctx.fillRect(left, u.bbox.top, Math.max(u.valToPos(to, "x", true) - left, 1), u.bbox.height);
  }
  u.ctx.restore();
}
