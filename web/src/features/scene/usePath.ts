/** The path of a reconstruction: the published trajectory, and beyond its end the poses that arrive live. */

import { useEffect, useState } from "react";

import { trajectory } from "../../shared/api/calls";
import type { Reconstruction, Trajectory, Version } from "../../shared/api/types";
import { poses } from "../../shared/state/poses";
import { useService } from "../../shared/state/store";
import { type Path, pathOf } from "./path";

const TAIL_MS = 250;
/** A path of minutes has millions of poses; the page shows no more than so many. */
const MOST_POSES = 20_000;

export function usePath(job: Reconstruction | null, pinned: Version | null): Path | null {
  const announced = useService((state) => (job === null ? undefined : state.scenes[job.id]?.version));
  const only = pinned?.version;
  const version = only ?? Math.max(job?.version ?? 0, announced ?? 0);
  const [published, setPublished] = useState<{ id: string; trajectory: Trajectory } | null>(null);
  const [path, setPath] = useState<{ id: string; path: Path } | null>(null);
  const id = job?.id ?? null;
  const step = Math.max(1, Math.ceil((pinned?.poses ?? job?.poses ?? 0) / MOST_POSES));
  useEffect(() => {
    if (id === null || version === 0) return;
    let current = true;
    trajectory(id, step, only).then(
      (value) => current && setPublished({ id, trajectory: value }),
      () => undefined, // fetched again with the next version
    );
    return () => {
      current = false;
    };
  }, [id, only, version, step]);

  const live = job?.live === true && job.state === "running" && only === undefined;
  const captureId = job?.capture_id ?? null;
  useEffect(() => {
    if (id === null) return;
    const base: Trajectory =
      published?.id === id
        ? published.trajectory
        : { version: 0, times_s: [], positions: [], quaternions_wxyz: [], frames: [], states: [] };
    let seen = -1;
    const join = (): void => {
      if (poses.version === seen) return;
      seen = poses.version;
      const end = base.frames.at(-1) ?? -1;
      setPath({ id, path: pathOf(base, live ? poses.after(captureId, end) : []) });
    };
    join();
    if (!live) return;
    const timer = setInterval(join, TAIL_MS);
    return () => clearInterval(timer);
  }, [published, id, live, captureId]);
  return path !== null && path.id === id ? path.path : null;
}
