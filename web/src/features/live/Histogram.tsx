/** Histogram of spike rates. */

import type { JSX } from "react";

import type { RateHistogram } from "../../shared/api/types";

const HEIGHT = 40;

/** Drop empty bins at the bright end, in quarters of the range, so that the scale stays stable. */
export function trimmed(histogram: RateHistogram): RateHistogram {
  const last = histogram.counts.findLastIndex((n) => n > 0) + 1;
  const quarter = Math.max(1, Math.ceil(histogram.counts.length / 4));
  const kept = Math.max(quarter, Math.ceil(last / quarter) * quarter);
  return { edges: histogram.edges.slice(0, kept + 1), counts: histogram.counts.slice(0, kept) };
}

/** Merge bins by two until few are empty: few frames give few distinct rates. */
export function merged(histogram: RateHistogram): RateHistogram {
  const { edges, counts } = histogram;
  const used = counts.slice(0, counts.findLastIndex((n) => n > 0) + 1);
  const empty = used.filter((n) => n === 0).length;
  if (counts.length <= 8 || counts.length % 2 === 1 || empty <= used.length / 4) return histogram;
  return merged({
    edges: edges.filter((_, i) => i % 2 === 0),
    counts: counts.filter((_, i) => i % 2 === 0).map((n, i) => n + (counts[2 * i + 1] ?? 0)),
  });
}

/** Bars with the square root of the counts, so that rare bright pixels are visible. */
export function bars(counts: readonly number[]): number[] {
  const most = Math.max(1, ...counts);
  return counts.map((n) => Math.sqrt(Math.max(n, 0) / most));
}

export function Histogram({
  histogram: all,
  meanRate,
  frameRateHz,
}: {
  histogram: RateHistogram | null;
  meanRate: number | null;
  frameRateHz: number | null;
}): JSX.Element {
  const histogram = all === null ? null : trimmed(merged(all));
  const heights = histogram === null ? [] : bars(histogram.counts);
  const first = histogram?.edges[0] ?? 0;
  const last = histogram?.edges.at(-1) ?? 1;
  const rateText = (rate: number): string =>
    frameRateHz === null ? `${rate.toFixed(2)} /frame` : `${((rate * frameRateHz) / 1000).toFixed(1)} kHz`;
  return (
    <figure className="histogram">
      <figcaption>
        Spike rate{" "}
        <span className="dim">
          {meanRate === null ? "" : `mean ${meanRate.toFixed(3)} /frame · ${rateText(meanRate)}`}
        </span>
      </figcaption>
      <svg
        viewBox={`0 0 ${Math.max(heights.length, 1)} ${HEIGHT}`}
        preserveAspectRatio="none"
        role="img"
        aria-label={
          histogram === null
            ? "Histogram of spike rate: nothing yet"
            : `Histogram of spike rate from ${first.toFixed(2)} to ${last.toFixed(2)} spikes a frame`
        }
      >
        {heights.map((height, i) => (
          <rect key={i} x={i + 0.08} y={HEIGHT * (1 - height)} width={0.84} height={HEIGHT * height} />
        ))}
      </svg>
      <div className="scale" aria-hidden="true">
        <span>{first.toFixed(2)}</span>
        <span>spikes a frame, √ of pixels</span>
        <span>{last.toFixed(2)}</span>
      </div>
    </figure>
  );
}
