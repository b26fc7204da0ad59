/** The path of a reconstruction: the published trajectory, and beyond its end the poses that arrive live. */

import { useEffect, useState } from "react";

import { trajectory } from "../api/calls";
import type { Reconstruction, Sensor, Trajectory } from "../api/types";
import { poses } from "../state/poses";
import { useService } from "../state/store";
import { type Path, pathOf } from "./path";

const TAIL_MS = 250;

export function usePath(job: Reconstruction | null, sensor: Sensor | null): Path | null {
  const announced = useService((state) => (job === null ? undefined : state.scenes[job.id]?.version));
  const version = Math.max(job?.version ?? 0, announced ?? 0);
  const [published, setPublished] = useState<{ id: string; trajectory: Trajectory } | null>(null);
  const [path, setPath] = useState<{ id: string; path: Path } | null>(null);
  const id = job?.id ?? null;
  useEffect(() => {
    if (id === null || version === 0) return;
    let current = true;
    trajectory(id).then(
      (value) => current && setPublished({ id, trajectory: value }),
      () => undefined, // asked again with the next version
    );
    return () => {
      current = false;
    };
  }, [id, version]);

  const rateHz = sensor?.frame_rate_hz ?? null;
  const live = job?.live === true && job.state === "running";
  const captureId = job?.capture_id ?? null;
  useEffect(() => {
    if (id === null || rateHz === null) return;
    const base: Trajectory =
      published?.id === id
        ? published.trajectory
        : { version: 0, times_s: [], positions: [], quaternions_wxyz: [], frames: [], states: [] };
    let seen = -1;
    const join = (): void => {
      if (poses.version === seen) return;
      seen = poses.version;
      const end = base.frames?.at(-1) ?? Math.round((base.times_s.at(-1) ?? -1) * rateHz);
      setPath({ id, path: pathOf(base, rateHz, live ? poses.after(captureId, end) : []) });
    };
    join();
    if (!live) return;
    const timer = setInterval(join, TAIL_MS);
    return () => clearInterval(timer);
  }, [published, id, rateHz, live, captureId]);
  return path !== null && path.id === id ? path.path : null;
}
