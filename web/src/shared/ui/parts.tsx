/** Small components shared by all pages. */

import { type JSX, type ReactNode, useId } from "react";

import type { Capture, CaptureState, DeviceState, Grade, JobState, Reconstruction, TrackingState } from "../api/types";
import { Icon, type IconName } from "./icons";

export type Tone = "good" | "warning" | "problem" | "active" | "quiet";

const BADGE_ICONS: Record<Tone, IconName | null> = {
  good: "good",
  warning: "warning",
  problem: "problem",
  active: null,
  quiet: null,
};

/** A state as text with an icon: colour is never the only cue. */
export function Badge({ tone, children }: { tone: Tone; children: ReactNode }): JSX.Element {
  const icon = BADGE_ICONS[tone];
  return (
    <span className={`badge ${tone}`}>
      {icon === null ? <i className="dot" aria-hidden="true" /> : <Icon name={icon} />}
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
  waiting: "problem",
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

/** Meaning of each tracking state. */
export const trackingMeaning: Record<TrackingState, string> = {
  boot: "Initialising: searching for a first map",
  track: "The camera is tracked",
  degraded: "The camera is tracked, with a larger error than the noise explains",
  lost: "Tracking is lost",
  reloc: "Relocalising in the map",
};

/** What to do with the camera in each state. */
const trackingAdvice: Record<TrackingState, string> = {
  boot: ": move the camera sideways, without turning it",
  track: "",
  degraded: ": move more slowly",
  lost: ": return to an area that was seen before",
  reloc: ": stay on an area that was seen before",
};

/** Advice is added only during a live capture. */
export const trackingHint = ({ tracking_state: state, live }: Reconstruction): string =>
  `${trackingMeaning[state]}${live ? trackingAdvice[state] : ""}.`;

/** Why a reconstruction failed or its path is degraded; nothing if there is no reason. */
export function JobReason({ job }: { job: Reconstruction }): JSX.Element | null {
  if (job.reason === "") return null;
  const degraded = job.state === "complete" && job.tracking_state !== "track";
  return (
    <p className={job.state === "failed" ? "problem reason" : "dim reason"}>
      {job.state === "failed" && "Failed: "}
      {degraded && `${job.tracking_state}: `}
      {job.reason}
    </p>
  );
}

/** Warnings of a capture or a reconstruction. */
export function Warnings({ texts }: { texts: readonly string[] }): JSX.Element {
  return (
    <>
      {texts.map((text) => (
        <p key={text} className="warning">
          {text}
        </p>
      ))}
    </>
  );
}

/** The grade of a capture's recording; its state while there is no grade. */
export function CaptureBadge({ capture: { state, verdict } }: { capture: Capture }): JSX.Element {
  return verdict === null ? (
    <Badge tone={captureTone[state]}>{state}</Badge>
  ) : (
    <Badge tone={gradeTone[verdict.grade]}>{verdict.grade}</Badge>
  );
}

/** State of a reconstruction: tracking state, then stage, then result. */
export function JobBadge({ job }: { job: Reconstruction }): JSX.Element {
  if (job.state === "complete" && job.tracking_state !== "track")
    return <Badge tone={trackingTone[job.tracking_state]}>complete, {job.tracking_state}</Badge>;
  if (job.state !== "running") return <Badge tone={jobTone[job.state]}>{job.state}</Badge>;
  if (job.stage !== "tracking") return <Badge tone="active">{job.stage}</Badge>;
  return (
    <span title={trackingHint(job)}>
      <Badge tone={trackingTone[job.tracking_state]}>{job.tracking_state}</Badge>
    </span>
  );
}

/** Text of the service, with `code` between backticks. */
export function Markup({ children }: { children: string }): JSX.Element {
  return <>{children.split("`").map((part, i) => (i % 2 === 1 ? <code key={i}>{part}</code> : part))}</>;
}

/** A bar for a share, 0 to 1. */
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

/** Radio buttons drawn as a segmented control. */
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

/** What names and describes an input. */
export interface Named {
  id: string;
  "aria-describedby": string;
}

/** An input with its name and a hint, which is its description: a screen reader reads the name first. */
export function Labelled({
  label,
  hint,
  children,
}: {
  label: string;
  hint: ReactNode;
  children: (called: Named) => ReactNode;
}): JSX.Element {
  const id = useId();
  return (
    <div className="field">
      <label htmlFor={id}>{label}</label>
      {children({ id, "aria-describedby": `${id}-hint` })}
      <small id={`${id}-hint`} className="dim">
        {hint}
      </small>
    </div>
  );
}

/** An empty state, with what to do about it. */
export function Empty({ icon, title, children }: { icon: IconName; title: string; children?: ReactNode }): JSX.Element {
  return (
    <div className="empty">
      <Icon name={icon} />
      <strong>{title}</strong>
      {children !== undefined && <div>{children}</div>}
    </div>
  );
}

/** An error message with an optional retry button. */
export function ErrorMessage({
  text,
  again,
  called = "Try again",
}: {
  text: string;
  again?: () => void;
  called?: string;
}): JSX.Element {
  return (
    <div className="error-message" role="alert">
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
