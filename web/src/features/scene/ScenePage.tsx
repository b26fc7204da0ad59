/** The Scene page: splats, path, timeline, and the view of the capture camera. */

import { type JSX, useCallback, useEffect, useMemo, useRef, useState } from "react";

import type { Capture, Intrinsics, Reconstruction, Sensor, Version } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { calledOf, nameOf, numberOf } from "../../shared/state/capture";
import { count } from "../../shared/state/format";
import { copy } from "../../shared/state/clipboard";
import { adjust, go, linkTo, nameFound, route, useRoute } from "../../shared/state/route";
import { isEnded, newestCapture, newestReconstruction, useService } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { useWanted, useWantedReconstruction } from "../../shared/state/useWanted";
import { Empty, ErrorMessage, JobReason, Loading, trackingHint } from "../../shared/ui/parts";
import { CompareStage, type Names } from "./CompareStage";
import { Inspector } from "./Inspector";
import { type Colouring, rowAt } from "./path";
import { type Comparison as Ride, comparisonOf, RideAlong } from "./RideAlong";
import { type Over, screenshot } from "./screenshot";
import { Scrubber } from "./Scrubber";
import { type Comparison as Compared, useComparison } from "./useComparison";
import { useSorting, useSplatsWanted } from "./useDrawing";
import { usePath } from "./usePath";
import { useClosures } from "./useClosures";
import { useScene } from "./useScene";
import { useSceneKeys } from "./useSceneKeys";
import { useVersions } from "./useVersions";
import { type Layers, type Size, type Steering, Viewer } from "./Viewer";
import { VIEW_MODES, type ViewMode } from "./viewModes";

const LAYERS: Layers = { splats: true, path: true, loops: true, frustum: true, grid: true, axes: true };
const LAYER_NAMES = Object.keys(LAYERS) as (keyof Layers)[];
const URL_MS = 300;

/** All layers but those that the address names. */
function layersWithout(hidden: string): Layers {
  const layers = { ...LAYERS };
  for (const name of LAYER_NAMES) layers[name] = !hidden.split(",").includes(name);
  return layers;
}

export function ScenePage(): JSX.Element {
  return (
    <>
      <h1 className="hidden">Scene</h1>
      <Wanted />
    </>
  );
}

function Wanted(): JSX.Element {
  const at = useRoute();
  const named = useWantedReconstruction(at.reconstruction);
  // A reconstruction that is named without a capture brings its own.
  const chosen = at.capture ?? named.job?.capture_id ?? null;
  const follows = at.capture === null && at.reconstruction === null;
  const capture = useService((state) =>
    follows ? newestCapture(state.captures) : chosen === null ? null : (state.captures[chosen] ?? null),
  );
  const newest = useService((state) => newestReconstruction(state.reconstructions, capture?.id ?? null));
  const job = at.reconstruction === null ? newest : named.job;
  const loaded = useService((state) => state.loaded);
  const unknown = useWanted(chosen, capture);
  const problem = unknown ?? named.problem;
  if (problem !== null)
    return (
      <ErrorMessage text={problem} again={() => go({ capture: null, reconstruction: null })} called="Newest scene" />
    );
  const awaited = (capture === null && (!loaded || !follows)) || (job === null && at.reconstruction !== null);
  if (awaited) return <Loading what="the scene" />;
  if (capture === null)
    return (
      <Empty icon="scene" title="No scene yet">
        A scene grows while a camera moves. <button onClick={() => go({ page: "live" })}>Start a capture</button>
      </Empty>
    );
  if (job === null)
    return (
      <Empty icon="scene" title="This capture has no reconstruction">
        <button onClick={() => go({ page: "captures", capture: capture.id })}>Reconstruct it</button>
      </Empty>
    );
  return <SceneView key={job.id} capture={capture} jobId={job.id} />;
}

function SceneView({ capture, jobId }: { capture: Capture; jobId: string }): JSX.Element | null {
  const at = useRoute();
  const job = useService((state) => state.reconstructions[jobId] ?? null);
  const [viewer, setViewer] = useState<Viewer | null>(null);
  const [fault, setFault] = useState<string | null>(null);
  const layers = useMemo(() => layersWithout(at.hide), [at.hide]);
  const colouring: Colouring = at.by === "speed" ? "speed" : "state";
  const [steering, setSteering] = useState<Steering>("orbit");
  const [full, setFull] = useState(false);
  const comparison = comparisonOf(at.how);
  const [share, setShare] = useState(0.5);
  const [splatsWanted, wantSplats] = useSplatsWanted();
  const sorting = useSorting(viewer);
  const asPoints = at.show === "" && viewer?.software === true && !splatsWanted;
  const mode = asPoints ? "points" : (VIEW_MODES.find((one) => one === at.show) ?? "colour");
  const versions = useVersions(job);
  const pinned = versions.find((one) => one.version === at.version) ?? null;
  const sensor = useSensor(capture, pinned ?? versions.at(-1));
  const gone = versions.length > 0 && pinned === null && at.version !== job?.version ? at.version : null;
  // After each change of the route: a step back may lead to an address that names what was found then.
  useEffect(() => nameFound(capture.id, jobId), [capture.id, jobId, at]);
  useEffect(() => () => nameFound(null, null), []);
  const path = usePath(job, pinned);
  const { shown, loading, problem } = useScene(viewer, job, full, pinned);

  const closures = useClosures(jobId, shown?.version ?? 0);
  const timer = useRef<ReturnType<typeof setTimeout>>(undefined);
  const onMoved = useCallback((moved: Viewer) => {
    clearTimeout(timer.current);
    timer.current = setTimeout(() => adjust({ camera: moved.view() }), URL_MS);
  }, []);
  const mount = useCallback(
    (canvas: HTMLCanvasElement | null) => {
      if (canvas === null) return;
      let made: Viewer;
      try {
        made = new Viewer(canvas, () => onMoved(made));
      } catch {
        setFault(
          "This browser has no WebGL 2, which the scene view requires. The pictures of the Live page work without it.",
        );
        return;
      }
      setViewer(made);
      return () => {
        clearTimeout(timer.current);
        made.dispose();
        setViewer(null);
      };
    },
    [onMoved],
  );
  const riding = at.ride && at.against === null;
  const compared = useComparison({ viewer, job, path, layers, colouring, mode, full, onMoved });

  const last = path?.frames.at(-1) ?? null;
  const row = path === null ? -1 : rowAt(path, at.frame ?? last ?? 0);
  useEffect(() => {
    if (viewer === null || path === null || row < 0 || sensor === null) return;
    viewer.setPose(
      [...path.positions.subarray(3 * row, 3 * row + 3)],
      [...path.quaternions.subarray(4 * row, 4 * row + 4)],
      sensor,
    );
  }, [viewer, path, row, sensor, shown?.version]);
  useEffect(() => {
    if (path !== null) viewer?.setPath(path, colouring);
  }, [viewer, path, colouring]);
  useEffect(() => {
    if (path !== null) viewer?.setLoops(path, closures.all, closures.fresh);
  }, [viewer, path, closures, shown?.version]);
  useEffect(() => viewer?.steer(steering), [viewer, steering]);
  useEffect(() => viewer?.setRiding(riding), [viewer, riding]);
  useEffect(() => viewer?.setMode(riding ? "colour" : mode), [viewer, riding, mode]);
  const leave = riding ? { ride: false, how: "" } : {};
  const onMode = (next: ViewMode): void => {
    if (next === "colour") wantSplats(); // else points are drawn without graphics hardware
    adjust({ ...leave, show: next === "colour" ? "" : next });
  };
  const onShows = (shows: ViewMode | "error"): void => {
    if (shows === "error") adjust({ ride: true, how: "difference", against: null, againstVersion: null });
    else onMode(shows);
  };
  useSceneKeys(viewer, mode, onMode, steering === "orbit" && !riding);
  const linked = at.camera;
  useEffect(() => {
    // Only views from a link or the history; the viewer's own updates are in effect already.
    if (viewer !== null && linked !== null && linked.some((x, i) => Math.abs(x - (viewer.view()[i] ?? 0)) > 1e-3))
      viewer.setView(linked);
  }, [viewer, linked]);

  if (job === null) return null;
  const copyLink = async (): Promise<void> => {
    const version = isEnded(job) ? (pinned?.version ?? (job.version > 0 ? job.version : null)) : at.version;
    await copy(linkTo({ version, camera: viewer?.view() ?? null }));
    toast("Copied the link to this view");
  };
  const save = async (wanted: Size | null): Promise<void> => {
    if (viewer === null) return;
    const over = overOf(viewer, riding ? comparison : null, compared);
    const { file, size } = await screenshot(viewer, over, share, wanted);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(file);
    const sized = wanted === null ? "" : `-${size.width}x${size.height}`;
    const how = over.kind === "nothing" ? "" : `-${over.how}`;
    link.download = `spiked-${capture.id}-v${viewer.version}${how}${sized}.png`;
    link.click();
    URL.revokeObjectURL(link.href);
    toast(`Saved ${link.download}`);
  };
  return (
    <div className="scene">
      <div className={riding ? "viewport ride" : "viewport"}>
        <div className={compared?.how === "side" ? "stage side" : "stage"}>
          <canvas
            ref={mount}
            tabIndex={0}
            role="application"
            aria-label={`Scene of ${nameOf(capture)}: ${shown === null ? "nothing drawn yet" : `${count(shown.splats)} splats, version ${shown.version}`}`}
            data-version={shown?.version ?? 0}
            data-splats={shown?.splats ?? 0}
          />
          {compared !== null && viewer !== null && (
            <CompareStage
              comparison={compared}
              names={namesOf(job, pinned, compared)}
              share={share}
              onShare={setShare}
            />
          )}
          {riding && sensor !== null && (
            <RideAlong
              capture={capture}
              jobId={job.id}
              version={pinned?.version}
              white={(pinned ?? job).white ?? undefined}
              sensor={sensor}
              frame={path?.frames[row] ?? null}
              comparison={comparison}
              share={share}
              onShare={setShare}
              onComparison={(how) => adjust({ how: how === "wipe" ? "" : how })}
            />
          )}
        </div>
        {shown !== null && sorting && <p className="sorting glass">Sorting the splats…</p>}
        <div className="stage-notes">
          {gone !== null && (
            <p className="glass" role="status">
              Version {gone} is not kept any more: this is the newest.
            </p>
          )}
          {shown !== null && asPoints && !riding && (
            <p className="glass" role="status">
              This browser draws without graphics hardware: points are faster.{" "}
              <button type="button" onClick={wantSplats}>
                Draw splats
              </button>
            </p>
          )}
        </div>
        {fault !== null && <ErrorMessage text={fault} />}
        {shown === null && fault === null && (
          <div className="veil">
            {problem !== null ? (
              <ErrorMessage text={problem} />
            ) : isEnded(job) && job.version === 0 ? (
              <Empty
                icon="problem"
                title={job.state === "failed" ? "The reconstruction has failed" : "This reconstruction has no scene"}
              >
                <JobReason job={job} />
              </Empty>
            ) : (
              <Empty
                icon="scene"
                title={
                  sorting ? "Sorting the splats…" : loading ? "Loading the scene…" : "Waiting for the first version…"
                }
              >
                {!loading && trackingHint(job)}
                {!loading && <JobReason job={job} />}
              </Empty>
            )}
          </div>
        )}
      </div>
      <Inspector
        viewer={viewer}
        capture={capture}
        job={job}
        versions={versions}
        pinned={pinned}
        onVersion={(version) => {
          setFull(false);
          // A version is one of this reconstruction, whatever is the newest later.
          adjust({ version, ...(version === null ? {} : { capture: capture.id, reconstruction: jobId }) });
        }}
        shown={shown}
        loading={loading}
        sensor={sensor}
        path={path}
        closures={closures}
        onTime={(time_s) => sensor !== null && adjust({ frame: Math.round(time_s * sensor.frame_rate_hz) })}
        full={full}
        onFull={() => setFull(true)}
        layers={layers}
        onLayers={(next) => adjust({ hide: LAYER_NAMES.filter((one) => !next[one]).join(",") })}
        colouring={colouring}
        onColouring={(by) => adjust({ by: by === "state" ? "" : by })}
        steering={steering}
        onSteering={setSteering}
        ride={riding}
        comparison={compared}
        onRide={(ride) => adjust({ ride, how: "", ...(ride ? { against: null, againstVersion: null } : {}) })}
        shows={riding && comparison === "difference" ? "error" : mode}
        onShows={onShows}
        fov={Math.round(at.camera?.[6] ?? viewer?.view()[6] ?? 0)}
        onFov={(fov) => viewer?.setFov(fov)}
        onPreset={(preset) => {
          adjust(leave);
          viewer?.look(preset);
        }}
        onHome={() => {
          viewer?.home();
          adjust({ camera: null });
        }}
        onScreenshot={(size) => void attempt(() => save(size))}
        onCopyLink={() => void attempt(copyLink)}
        currentView={() => ({ camera: viewer?.view() ?? [], frame: route().frame })}
        onView={(camera, frame) => adjust({ camera, frame, ...leave })}
      />
      <Scrubber
        path={path}
        row={row}
        frameRateHz={sensor?.frame_rate_hz ?? null}
        live={job.live && job.state === "running" && pinned === null}
        jobId={job.id}
        version={shown?.version ?? 0}
      />
    </div>
  );
}

/** What lies over the scene: the picture of the camera along the ride, or the other scene of a comparison. */
function overOf(viewer: Viewer, ride: Ride | null, compared: Compared | null): Over {
  if (ride !== null)
    return { kind: "camera", how: ride, picture: viewer.canvas.parentElement?.querySelector("img.observed") ?? null };
  if (compared?.viewer == null || compared.how === "paths") return { kind: "nothing" };
  return { kind: "scene", viewer: compared.viewer, how: compared.how };
}

/** The sensor with the optics that a version was made with: the reconstruction may have found them. */
function useSensor({ sensor }: Capture, version: Version | undefined): Sensor | null {
  const intrinsics = version?.intrinsics ?? sensor?.intrinsics ?? null;
  // The same object for the same numbers, however often the versions are fetched.
  const optics = JSON.stringify(intrinsics);
  return useMemo(
    () => (sensor === null ? null : { ...sensor, intrinsics: JSON.parse(optics) as Intrinsics | null }),
    [sensor, optics],
  );
}

/** What each side of a comparison is called. */
function namesOf(job: Reconstruction, pinned: Version | null, compared: Compared): Names {
  const version = (one: Reconstruction | null, known: number | null): string => `version ${known ?? one?.version ?? 0}`;
  const first = version(job, pinned?.version ?? null);
  const second = version(compared.job, compared.version);
  if (compared.job === null || compared.job.id === job.id) return { first, second };
  const { reconstructions, captures } = useService.getState();
  const near = compared.job.capture_id === job.capture_id; // the newest of this capture are known
  const of = captures[job.capture_id]?.reconstruction_count ?? 0;
  const name = (one: Reconstruction): string =>
    `${near ? `${numberOf(one, Object.values(reconstructions), of)}, ` : ""}${calledOf(one)}`;
  return {
    first: `${name(job)}, ${first}`,
    second: `${name(compared.job)}, ${second}`,
  };
}
