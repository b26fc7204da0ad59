/** The small parts that every page is made of. */

import type { JSX, ReactNode } from "react";

import type { CaptureState, DeviceState, Grade, JobState, Reconstruction, TrackingState } from "../api/types";
import { Icon, type IconName } from "./icons";

export type Tone = "good" | "warning" | "problem" | "active" | "quiet";

const SIGNS: Record<Tone, IconName | null> = {
  good: "good",
  warning: "warning",
  problem: "problem",
  active: null,
  quiet: null,
};

/** A state in a word, with a sign beside the colour: nothing is told by colour alone. */
export function Badge({ tone, children }: { tone: Tone; children: ReactNode }): JSX.Element {
  const sign = SIGNS[tone];
  return (
    <span className={`badge ${tone}`}>
      {sign === null ? <i className="dot" aria-hidden="true" /> : <Icon name={sign} />}
      {children}
    </span>
  );
}

export const deviceTone: Record<DeviceState, Tone> = {
  absent: "quiet",
  idle: "quiet",
  armed: "active",
  streaming: "active",
  lost: "problem",
};
export const captureTone: Record<CaptureState, Tone> = {
  starting: "active",
  streaming: "active",
  finishing: "active",
  complete: "good",
  failed: "problem",
};
export const jobTone: Record<JobState, Tone> = {
  queued: "quiet",
  running: "active",
  complete: "good",
  cancelled: "quiet",
  failed: "problem",
};
export const gradeTone: Record<Grade, Tone> = { good: "good", degraded: "warning", bad: "problem" };
export const trackingTone: Record<TrackingState, Tone> = {
  boot: "active",
  track: "good",
  degraded: "warning",
  lost: "problem",
  reloc: "warning",
};

/** What a state of the tracking means, and what to do with the camera then. */
export const trackingHint: Record<TrackingState, string> = {
  boot: "Looking for a first map: move the camera sideways, without turning it.",
  track: "The camera is followed.",
  degraded: "The camera is followed with more error than its noise explains: move more slowly.",
  lost: "The camera is not followed: go back to what it has seen.",
  reloc: "The camera is looked for in the map: hold it on what it has seen.",
};

/** What a reconstruction is at: how it follows the camera while it does, then what it works at, then how it ended. */
export function JobBadge({ job }: { job: Reconstruction }): JSX.Element {
  if (job.state !== "running") return <Badge tone={jobTone[job.state]}>{job.state}</Badge>;
  if (job.stage !== "tracking") return <Badge tone="active">{job.stage}</Badge>;
  return (
    <span title={trackingHint[job.tracking_state]}>
      <Badge tone={trackingTone[job.tracking_state]}>{job.tracking_state}</Badge>
    </span>
  );
}

/** A sentence of the service, with what it puts between backticks as code. */
export function Words({ children }: { children: string }): JSX.Element {
  return <>{children.split("`").map((part, i) => (i % 2 === 1 ? <code key={i}>{part}</code> : part))}</>;
}

/** A share of something, 0 to 1. */
export function Meter({ share, label, tone = "active" }: { share: number; label: string; tone?: Tone }): JSX.Element {
  const value = Math.min(Math.max(share, 0), 1);
  return (
    <svg
      className={`meter ${tone}`}
      role="meter"
      aria-label={label}
      aria-valuenow={Math.round(100 * value)}
      aria-valuemin={0}
      aria-valuemax={100}
      viewBox="0 0 100 6"
      preserveAspectRatio="none"
    >
      <rect className="trough" width="100" height="6" />
      <rect className="level" width={100 * value} height="6" />
    </svg>
  );
}

/** One number with its name. */
export function Stat({
  name,
  children,
  hint,
}: {
  name: string;
  children: ReactNode;
  hint?: string | undefined;
}): JSX.Element {
  return (
    <div className="stat" title={hint}>
      <dt>{name}</dt>
      <dd>{children}</dd>
    </div>
  );
}

export function Panel({
  title,
  aside,
  children,
  className = "",
}: {
  title: string;
  aside?: ReactNode;
  children: ReactNode;
  className?: string;
}): JSX.Element {
  const id = `panel-${title.toLowerCase().replaceAll(/\W+/g, "-")}`;
  return (
    <section className={`panel ${className}`} aria-labelledby={id}>
      <header>
        <h2 id={id}>{title}</h2>
        {aside}
      </header>
      {children}
    </section>
  );
}

/** One of a few: radio buttons that look like a row of keys. */
export function Segmented<T extends string>({
  label,
  value,
  choices,
  onChange,
}: {
  label: string;
  value: T;
  choices: readonly { value: T; label: string; hint?: string }[];
  onChange: (value: T) => void;
}): JSX.Element {
  const name = `choice-${label.toLowerCase().replaceAll(/\W+/g, "-")}`;
  return (
    <fieldset className="segmented">
      <legend className="hidden">{label}</legend>
      {choices.map((choice) => (
        <label key={choice.value} title={choice.hint}>
          <input type="radio" name={name} checked={value === choice.value} onChange={() => onChange(choice.value)} />
          <span>{choice.label}</span>
        </label>
      ))}
    </fieldset>
  );
}

/** Nothing there, and what to do about it. */
export function Empty({ icon, title, children }: { icon: IconName; title: string; children?: ReactNode }): JSX.Element {
  return (
    <div className="empty">
      <Icon name={icon} />
      <strong>{title}</strong>
      {children !== undefined && <div>{children}</div>}
    </div>
  );
}

/** Something went wrong, in the service's words, with a way to try again. */
export function Trouble({
  text,
  again,
  called = "Try again",
}: {
  text: string;
  again?: () => void;
  called?: string;
}): JSX.Element {
  return (
    <div className="trouble" role="alert">
      <Icon name="warning" />
      <span>{text}</span>
      {again !== undefined && (
        <button type="button" onClick={again}>
          {called}
        </button>
      )}
    </div>
  );
}

export function Loading({ what }: { what: string }): JSX.Element {
  return (
    <p className="loading" role="status">
      Loading {what}…
    </p>
  );
}
