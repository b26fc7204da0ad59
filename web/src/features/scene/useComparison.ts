/** A second scene beside the first: what it is, its viewer with the same camera, and how far the paths are apart. */

import { useCallback, useEffect, useMemo, useState } from "react";

import type { Reconstruction } from "../../shared/api/types";
import { adjust, useRoute } from "../../shared/state/route";
import { useWantedReconstruction } from "../../shared/state/useWanted";
import { ComparedPaths } from "./ComparedPaths";
import type { Colouring, Path } from "./path";
import { IDENTITY, inverse, matrixOf, rmsDistance, type Similarity, similarityOf } from "./similarity";
import { COMPARED_STYLES } from "./stateStyles";
import { usePath } from "./usePath";
import { type Shown, useScene } from "./useScene";
import { useVersions } from "./useVersions";
import { type Layers, Viewer } from "./Viewer";
import type { ViewMode } from "./viewModes";

export const HOWS = ["side", "wipe", "difference", "paths"] as const;
export type How = (typeof HOWS)[number];

export interface Errors {
  /** Of the second path from the first, units of the first scene. */
  between: number | null;
  /** Of each path from the truth, units of the truth. */
  first: number | null;
  second: number | null;
}

export interface Comparison {
  how: How;
  /** The reconstruction that is compared with; null until it is known. */
  job: Reconstruction | null;
  /** Its version; null: the newest. */
  version: number | null;
  /** That of its canvas; null before there is one. */
  viewer: Viewer | null;
  shown: Shown | null;
  path: Path | null;
  problem: string | null;
  /** Whether it could be laid over the first by the common times of their paths. */
  aligned: boolean;
  errors: Errors;
  truth: Path | null;
  onTruth: (truth: Path | null) => void;
  /** For the canvas of the second scene. */
  mount: (canvas: HTMLCanvasElement | null) => (() => void) | undefined;
}

/** Only what both scenes are compared by. */
const layersOf = (layers: Layers, how: How): Layers => ({
  splats: layers.splats,
  path: layers.path && (how === "side" || how === "wipe"),
  loops: false,
  frustum: false,
  grid: false,
  axes: false,
});

export interface FirstScene {
  viewer: Viewer | null;
  job: Reconstruction | null;
  path: Path | null;
  layers: Layers;
  colouring: Colouring;
  mode: ViewMode;
  full: boolean;
  onMoved: (viewer: Viewer) => void;
}

/** The comparison that the address names; null: none. */
export function useComparison(first: FirstScene): Comparison | null {
  const at = useRoute();
  const { viewer, layers } = first;
  const how = HOWS.find((one) => one === at.how) ?? "side";
  const on = at.against !== null;
  const { job, problem: unknown } = useWantedReconstruction(at.against);
  const versions = useVersions(job);
  const pinned = versions.find((one) => one.version === at.againstVersion) ?? null;
  const known = at.againstVersion === null || pinned !== null || at.againstVersion === job?.version;
  const compared = known ? job : null;
  const [second, mount] = useSecondViewer(viewer, first.onMoved);
  const path = usePath(compared, pinned);
  const { shown, problem } = useScene(second, compared, first.full, pinned);
  const [truth, setTruth] = useState<Path | null>(null);
  const similarity = useMemo(
    () => (first.path === null || path === null ? null : alignment(path, first.path, job, first.job)),
    [first.path, path, job, first.job],
  );
  const errors = useErrors(first.path, path, truth, similarity);

  useEffect(() => viewer?.setLayers(on ? layersOf(layers, how) : layers), [viewer, layers, on, how]);
  useEffect(() => second?.setLayers(layersOf(layers, how)), [second, layers, how]);
  useEffect(() => second?.setMode(first.mode), [second, first.mode, shown?.version]);
  useEffect(() => {
    if (path !== null) second?.setPath(path, first.colouring);
  }, [second, path, first.colouring]);
  useEffect(() => second?.align(matrixOf(similarity ?? IDENTITY)), [second, similarity]);
  useComparedPaths(on && how === "paths" ? viewer : null, first.path, path, similarity, truth);

  if (!on) return null;
  const missing = !known && versions.length > 0 ? `Version ${at.againstVersion ?? 0} is not kept any more.` : null;
  return {
    how,
    job,
    version: at.againstVersion,
    viewer: second,
    shown,
    path,
    problem: unknown ?? missing ?? problem,
    aligned: similarity !== null,
    errors,
    truth,
    onTruth: setTruth,
    mount,
  };
}

export const stopComparing = (): void => adjust({ against: null, againstVersion: null, how: "" });

/** A viewer on the second canvas whose camera is that of the first, whichever of them is moved. */
function useSecondViewer(
  first: Viewer | null,
  onMoved: (viewer: Viewer) => void,
): [Viewer | null, Comparison["mount"]] {
  const [second, setSecond] = useState<Viewer | null>(null);
  const mount = useCallback(
    (canvas: HTMLCanvasElement | null) => {
      if (canvas === null || first === null) return;
      const made: Viewer = new Viewer(canvas, () => onMoved(made));
      made.follow(first);
      setSecond(made);
      return () => {
        made.dispose();
        setSecond(null);
      };
    },
    [first, onMoved],
  );
  return [second, mount];
}

/** The second scene over the first: as it is if they share a map, else by the poses at common times of one capture. */
function alignment(
  path: Path,
  onto: Path,
  job: Reconstruction | null,
  first: Reconstruction | null,
): Similarity | null {
  if (job === null || first === null || job.capture_id !== first.capture_id) return null;
  return similarityOf(path, onto, "turns");
}

function useErrors(first: Path | null, second: Path | null, truth: Path | null, similarity: Similarity | null): Errors {
  return useMemo(() => {
    const against = (path: Path | null): number | null => {
      if (path === null || truth === null) return null;
      const by = similarityOf(path, truth, "places");
      return by === null ? null : rmsDistance(path, truth, by);
    };
    const between =
      first === null || second === null || similarity === null ? null : rmsDistance(second, first, similarity);
    return { between, first: against(first), second: against(second) };
  }, [first, second, truth, similarity]);
}

/** Draw both paths, and the truth, over the first scene. */
function useComparedPaths(
  viewer: Viewer | null,
  first: Path | null,
  second: Path | null,
  similarity: Similarity | null,
  truth: Path | null,
): void {
  useEffect(() => {
    if (viewer === null || first === null) return;
    const [below, middle, above] = [new ComparedPaths(0), new ComparedPaths(1), new ComparedPaths(2)];
    below.set(first, IDENTITY, COMPARED_STYLES.first);
    if (second !== null) middle.set(second, similarity ?? IDENTITY, COMPARED_STYLES.second);
    const onto = truth === null ? null : similarityOf(first, truth, "places");
    if (truth !== null && onto !== null) above.set(truth, inverse(onto), COMPARED_STYLES.truth);
    viewer.overlays.add(below, middle, above);
    viewer.draw();
    return () => {
      for (const lines of [below, middle, above]) lines.clear().removeFromParent();
      viewer.draw();
    };
  }, [viewer, first, second, similarity, truth]);
}
