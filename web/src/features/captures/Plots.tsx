/** Plots of a reconstruction over capture time or over its work, optionally compared with another. */

import { type JSX, useEffect, useMemo, useState } from "react";

import { timeline as fetchTimeline } from "../../shared/api/calls";
import type { Capture, Reconstruction, Timeline } from "../../shared/api/types";
import { isEnded } from "../../shared/state/store";
import { useFetch } from "../../shared/state/useFetch";
import { Empty, Loading, Panel, ErrorMessage, Segmented } from "../../shared/ui/parts";
import { gapSpans, Plot, type PlotProps } from "./Plot";
import { along, type Axis, type Column, flicker, hasWork, isKnown, joined, PLOTS } from "./series";

const LIVE_MS = 2000;
const AXES: readonly { value: Axis; label: string; hint: string }[] = [
  { value: "capture", label: "Capture", hint: "Time of the capture" },
  {
    value: "work",
    label: "Work",
    hint: "Seconds that the reconstruction worked, the refinement after the last frame, too",
  },
];
/** Points of a plot: several for each pixel, so that zooming in shows more. */
const POINTS = 5000;

export function Plots({
  capture,
  job,
  other,
  nameOf,
}: {
  capture: Capture;
  job: Reconstruction;
  other: Reconstruction | null;
  nameOf: (job: Reconstruction) => string;
}): JSX.Element {
  const own = useFetch(job.id, () => fetchTimeline(job.id, { points: POINTS }));
  const beside = useFetch(other?.id ?? null, () => fetchTimeline(other?.id ?? "", { points: POINTS }));
  const ended = isEnded(job);
  const { again } = own;
  useEffect(() => {
    if (ended) return;
    const timer = setInterval(again, LIVE_MS);
    return () => {
      clearInterval(timer);
      again(); // values between the last request and the end
    };
  }, [ended, again]);

  const [axis, setAxis] = useState<Axis>("capture");
  const rateHz = capture.sensor?.frame_rate_hz ?? null;
  const ownName = nameOf(job);
  const otherName = other === null ? "" : nameOf(other);
  const plots = useMemo(
    () => (own.value === null ? [] : plotsOf(own.value, ownName, beside.value, otherName, rateHz, axis)),
    [own.value, beside.value, ownName, otherName, rateHz, axis],
  );
  return (
    <Panel
      title="Over time"
      aside={
        own.value !== null &&
        hasWork(own.value) && <Segmented label="Plotted over" value={axis} choices={AXES} onChange={setAxis} />
      }
    >
      {own.problem !== null && <ErrorMessage text={own.problem} again={own.again} />}
      {own.value === null && own.loading && <Loading what="the timeline" />}
      {own.value !== null && plots.length === 0 && <Empty icon="live" title="No measurements yet" />}
      <div className="plots">
        {plots.map((plot) => (
          <Plot key={plot.title} {...plot} />
        ))}
      </div>
      {own.value !== null && <Gaps timeline={own.value} rateHz={rateHz} />}
    </Panel>
  );
}

function plotsOf(
  own: Timeline,
  ownName: string,
  beside: Timeline | null,
  besideName: string,
  rateHz: number | null,
  axis: Axis,
): PlotProps[] {
  const gaps = rateHz === null || axis === "work" ? [] : gapSpans(own.gaps, rateHz);
  const plot = (
    spec: { title: string; unit: string; hint: string; log: boolean },
    of: (timeline: Timeline) => [number[], Column],
  ): PlotProps[] => {
    const [times, first] = of(own);
    if (!isKnown(first)) return [];
    const [otherTimes, second] = beside === null ? [[], null] : of(beside);
    const compared = second !== null && isKnown(second);
    return [
      {
        title: spec.title,
        unit: spec.unit,
        hint: spec.hint,
        log: spec.log,
        gaps,
        names: compared ? [ownName, besideName] : [spec.title],
        axis,
        data: compared ? joined([times, otherTimes], [first, second]) : [times, first],
      },
    ];
  };
  return [
    ...PLOTS.flatMap((spec) => plot(spec, (timeline) => along(timeline, spec.key, axis))),
    ...(axis === "work"
      ? []
      : plot(
          {
            title: "Flicker",
            unit: "%",
            log: false,
            hint: "Deviation of the spike rate from its mean over 10 ms, in percent",
          },
          (timeline) => [timeline.time_s, flicker(timeline)],
        )),
  ];
}

function Gaps({ timeline, rateHz }: { timeline: Timeline; rateHz: number | null }): JSX.Element {
  if (timeline.gaps.length === 0) return <p className="dim">No frames are missing.</p>;
  return (
    <table className="grid gaps">
      <caption className="hidden">Gaps</caption>
      <thead>
        <tr>
          <th scope="col">Gap at (shaded in the plots)</th>
          <th scope="col" className="number">
            Frames missing
          </th>
          <th scope="col">Cause</th>
        </tr>
      </thead>
      <tbody>
        {timeline.gaps.slice(0, 200).map((gap) => (
          <tr key={gap.first}>
            <td>
              frame {gap.first}
              {rateHz !== null && `, ${((1000 * gap.first) / rateHz).toFixed(2)} ms`}
            </td>
            <td className="number">{gap.count}</td>
            <td>{gap.cause}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}
