/** The scene on a canvas: Gaussians by Spark, path, frustum, grid and axes by three.js. Draws only after changes. */

import { ExtSplats, SparkRenderer, SplatMesh, utils } from "@sparkjsdev/spark";
import {
  AxesHelper,
  Box3,
  Box3Helper,
  Color,
  GridHelper,
  Group,
  type Matrix4,
  type Mesh,
  type Object3D,
  PerspectiveCamera,
  Quaternion,
  Raycaster,
  Scene,
  SpriteMaterial,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { FlyControls } from "three/addons/controls/FlyControls.js";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

import type { Closure, Sensor } from "../../shared/api/types";
import { colour } from "../../shared/state/theme";
import { type Placement, placementOf, pointOf, projectionOf } from "./axes";
import { axisNames } from "./axisNames";
import { type Changes, changed, NO_SLOTS, type Slots } from "./changes";
import type { Box } from "./cropBox";
import { type Colouring, type Path, quantile } from "./path";
import { countInside, type Outline, outlineOf, type Point } from "./lasso";
import { LoopLines } from "./loops";
import { MarkLines } from "./MarkLines";
import { OVERLAY_ORDER, PathLines } from "./PathLines";
import { distanceAlong } from "./picker";
import { Pace } from "./pace";
import { type Preset, presetDirection } from "./presets";
import { showInHeadset } from "./vr";
import { show as showMode, type ViewMode } from "./viewModes";

export type Steering = "orbit" | "fly";

/** Of a picture, pixels. */
export interface Size {
  width: number;
  height: number;
}

export interface Layers {
  splats: boolean;
  path: boolean;
  loops: boolean;
  frustum: boolean;
  grid: boolean;
  axes: boolean;
}

const FRUSTUM_PX = 1.6;
/** Size of the diamonds at closed loops, in units of the depth of the scene. */
const LOOP_SIZE = 0.03;
/** The same of the crosses at points that are measured. */
const MARK_SIZE = 0.012;
/** More pixels for one of the style sheets are not seen. */
const MOST_SHARPNESS = 2;
const SAMPLE = 20_000;
/** Pixels that are drawn for one of the canvas, each way, while a slow machine draws a moving view. */
const MOVING_SHARE = 0.5;
/** A moving view has come to rest after this, ms. */
const REST_MS = 150;
/** Two taps within this time and this way are one double tap, ms and px. */
const [DOUBLE_TAP_MS, DOUBLE_TAP_PX] = [350, 30];
/** How often it is looked whether splats are drawn, ms. */
const LOOK_MS = 30;
/** Longest wait for a sorting that is under way, ms. */
const LONGEST_SORT_MS = 5000;
/** Room for splats that come later, so that a growing scene does not get new textures with every version. */
const HEADROOM = 1.25;

/** Blur of the service's own renderer, px^2 added to the projected covariance, so that both show the same picture. */
const DILATION_PX2 = 0.3;

/** The largest of 1, 2 and 5 times a power of ten that is not above `length`. */
export function roundLength(length: number): number {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * ([5, 2].find((step) => step * power <= length) ?? 1);
}

interface Extent {
  /** Where the splats are, as seen from the first pose: median distance. */
  depth: number;
  /** Height of the floor, y of three.js. */
  floor: number;
}

const moment = (): Promise<unknown> => new Promise((resolve) => setTimeout(resolve, LOOK_MS));

/** Whether a context is drawn by the processor. */
function drawsInSoftware(context: WebGLRenderingContext | WebGL2RenderingContext): boolean {
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name: unknown = context.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER);
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(String(name));
}

/** Free what a drawn object has of its own. */
function freeGraphics(one: Object3D): void {
  const { geometry, material } = one as Partial<Mesh>;
  geometry?.dispose();
  for (const each of [material ?? []].flat()) {
    if (each instanceof SpriteMaterial) each.map?.dispose();
    each.dispose();
  }
}

export class Viewer {
  /** Version of the scene that is shown; 0 before the first. */
  version = 0;
  splats = 0;
  /** Whether there is no graphics hardware behind the canvas. */
  readonly software: boolean;
  private readonly renderer: WebGLRenderer;
  private readonly world = new Scene();
  /** Parent of objects in OpenCV axes. */
  private readonly turned = new Group();
  /** The splats and the path, which `align` moves. */
  private readonly content = new Group();
  /** Lines that others draw over the scene. */
  readonly overlays = new Group();
  /** The viewer whose camera this one has; it has the depth of the scene, too. */
  private lead: Viewer | null = null;
  /** The viewer that has the camera of this one. */
  private follower: Viewer | null = null;
  private readonly spark: SparkRenderer;
  private readonly camera = new PerspectiveCamera(55, 1, 0.01, 1000);
  private readonly rider = new PerspectiveCamera();
  private readonly orbit: OrbitControls;
  private fly: FlyControls | null = null;
  private steering: Steering = "orbit";
  private mesh: SplatMesh | null = null;
  private slots: Slots = NO_SLOTS;
  /** The box around the splats of some slots. */
  private bounded: { slots: Slots; box: Box | null } | null = null;
  /** Splats for which the textures have room. */
  private capacity = 0;
  private readonly path = new PathLines();
  private readonly loops = new LoopLines();
  private readonly marks = new MarkLines();
  private readonly frustum = new LineSegments2(new LineSegmentsGeometry(), new LineMaterial({ linewidth: FRUSTUM_PX }));
  private readonly crop = new Box3Helper(new Box3(), colour("mark"));
  private grid = new GridHelper(1, 1);
  private readonly gridColour = new Color();
  private readonly axes = new AxesHelper(1);
  private layers: Layers = { splats: true, path: true, loops: true, frustum: true, grid: true, axes: true };
  private extent: Extent | null = null;
  private placement: Placement | null = null;
  private sensor: Sensor | null = null;
  private riding = false;
  private mode: ViewMode = "colour";
  private placed = false;
  private scheduled = 0;
  /** Whether a headset draws. */
  private presenting = false;
  private disposed = false;
  private lastMs = 0;
  /** Whether fewer pixels are drawn: the view moves, and this machine is too slow for all of them. */
  private coarse = false;
  private readonly pace: Pace;
  /** Whether the view is held and turned. */
  private held = false;
  /** Runs while the view moves. */
  private resting: ReturnType<typeof setTimeout> | undefined;
  private lastTap: { atMs: number; x: number; y: number } | null = null;
  private loading = 0;
  private readonly resizing: ResizeObserver;

  /** @param onMoved called when the user has moved the camera. */
  constructor(
    readonly canvas: HTMLCanvasElement,
    private readonly onMoved: () => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(this.sharpness);
    this.software = drawsInSoftware(this.renderer.getContext());
    this.pace = new Pace(this.software);
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: this.draw,
      preBlurAmount: DILATION_PX2,
      blurAmount: 0,
      sortRadial: false,
      accumExtSplats: true,
      enableLod: false,
    });
    this.turned.quaternion.set(1, 0, 0, 0);
    this.content.add(this.turned, this.path);
    this.world.add(this.spark, this.content, this.loops, this.marks, this.overlays, this.crop, this.frustum, this.axes);
    this.frustum.renderOrder = OVERLAY_ORDER;
    this.frustum.frustumCulled = false;
    this.frustum.material.depthTest = false;
    this.frustum.material.transparent = true;
    this.frustum.visible = false;
    const around = canvas.parentElement ?? document.body;
    this.renderer.setClearColor(new Color(colour("viewport")), 1);
    this.frustum.material.color.set(colour("accent", around));
    this.gridColour.set(colour("line", around));
    this.path.visible = false;
    this.crop.visible = false;
    // Of the capture's world, OpenCV's: y points down and z ahead.
    this.axes.scale.set(1, -1, -1);
    this.axes.setColors(new Color(colour("axis-x")), new Color(colour("axis-y")), new Color(colour("axis-z")));
    const names = axisNames();
    names.scale.set(1, -1, -1);
    this.axes.add(names);
    this.axes.visible = false;
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.addEventListener("change", () => {
      this.lead?.takeCamera(this);
      if (this.held) this.moves();
      this.draw();
    });
    this.orbit.addEventListener("start", () => {
      this.held = true;
    });
    this.orbit.addEventListener("end", () => {
      this.held = false;
      this.placed = true;
      this.onMoved();
    });
    this.orbit.listenToKeyEvents(canvas);
    canvas.addEventListener("focus", this.flyWhileFocused);
    canvas.addEventListener("blur", this.flyWhileFocused);
    this.resizing = new ResizeObserver(() => this.resize());
    this.resizing.observe(canvas);
    canvas.addEventListener("webglcontextlost", this.onLost);
    canvas.addEventListener("webglcontextrestored", this.draw);
    canvas.addEventListener("dblclick", this.onDoubleClick);
    canvas.addEventListener("pointerup", this.onTap);
    this.resize();
  }

  dispose(): void {
    this.disposed = true;
    void this.renderer.xr.getSession()?.end();
    cancelAnimationFrame(this.scheduled);
    if (this.lead !== null) this.lead.follower = null;
    this.resizing.disconnect();
    this.orbit.dispose();
    this.fly?.dispose();
    this.canvas.removeEventListener("focus", this.flyWhileFocused);
    this.canvas.removeEventListener("blur", this.flyWhileFocused);
    this.mesh?.dispose();
    this.path.clear();
    this.loops.clear();
    this.marks.clear();
    this.canvas.removeEventListener("webglcontextlost", this.onLost);
    this.canvas.removeEventListener("webglcontextrestored", this.draw);
    this.canvas.removeEventListener("dblclick", this.onDoubleClick);
    this.canvas.removeEventListener("pointerup", this.onTap);
    clearTimeout(this.resting);
    this.loading += 1;
    void this.release();
  }

  /** Give everything back to the graphics, when the sorting under way has ended: its worker still writes into it. */
  private async release(): Promise<void> {
    const { spark, renderer } = this;
    spark.autoUpdate = spark.sortDirty = false;
    const latestMs = performance.now() + LONGEST_SORT_MS;
    await moment(); // the canvas is taken away after this
    while (spark.sorting && performance.now() < latestMs) await moment();
    this.world.traverse(freeGraphics);
    spark.dispose();
    renderer.dispose();
    // A browser has some sixteen contexts, and takes away the oldest; one of a canvas that is used again is kept.
    if (!this.canvas.isConnected) renderer.forceContextLoss();
  }

  /** Draw in the next animation frame, once for any number of calls. */
  readonly draw = (): void => {
    if (this.scheduled !== 0) return;
    this.scheduled = requestAnimationFrame(this.render);
    this.pace.request(performance.now());
  };

  private readonly onDoubleClick = (event: MouseEvent): void => {
    const touched = (event as Partial<PointerEvent>).pointerType === "touch" || this.lastTap !== null;
    if (!touched && !this.riding && this.lead === null) this.focus(event.clientX, event.clientY);
  };

  /** Not every browser tells a double tap as a double click. */
  private readonly onTap = (event: PointerEvent): void => {
    const { timeStamp: atMs, clientX: x, clientY: y } = event;
    const before = this.lastTap;
    this.lastTap = event.pointerType === "touch" ? { atMs, x, y } : null;
    if (before === null || this.lastTap === null || atMs - before.atMs > DOUBLE_TAP_MS) return;
    if (Math.hypot(x - before.x, y - before.y) > DOUBLE_TAP_PX) return;
    if (!this.riding && this.lead === null) this.focus(x, y);
  };

  /** The view moves: a slow machine draws fewer pixels until it rests. */
  private moves(): void {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => {
      this.resting = undefined;
      this.sharpen(false);
    }, REST_MS);
    if (this.pace.slow) this.sharpen(true);
    this.follower?.moves();
  }

  private sharpen(coarse: boolean): void {
    if (coarse === this.coarse) return;
    this.coarse = coarse;
    this.renderer.setPixelRatio(this.sharpness * (coarse ? MOVING_SHARE : 1));
    this.draw();
  }

  /** Whether splats are being sorted for a new view or version. */
  get sorting(): boolean {
    return this.spark.sorting;
  }

  private readonly onLost = (event: Event): void => event.preventDefault();

  private readonly render = (nowMs: number): void => {
    this.scheduled = 0;
    if (this.presenting) return;
    const elapsed = Math.min((nowMs - this.lastMs) / 1000, 0.1);
    this.lastMs = nowMs;
    this.pace.drawn(nowMs, this.resting !== undefined);
    if (this.fly !== null) {
      const before = this.camera.matrix.elements.slice();
      this.fly.update(elapsed);
      this.camera.updateMatrix();
      if (this.camera.matrix.elements.some((value, i) => value !== before[i])) {
        this.moves();
        this.onMoved();
      }
      this.draw(); // keys are held between events
    }
    this.follower?.takeCamera(this);
    this.path.dashFor(this.camera, this.canvas.clientHeight);
    this.renderer.render(this.world, this.riding ? this.rider : this.camera);
  };

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  setLayers(layers: Layers): void {
    this.layers = layers;
    this.show();
  }

  private show(): void {
    const { layers } = this;
    if (this.mesh !== null) this.mesh.visible = layers.splats;
    this.path.visible = layers.path && !this.riding;
    this.loops.visible = layers.loops && !this.riding;
    // The size of the frustum follows the scene, so none is drawn before there is one.
    const placed = this.extent !== null && this.placement !== null && this.sensor !== null;
    this.frustum.visible = layers.frustum && !this.riding && placed;
    this.grid.visible = layers.grid && !this.riding && this.extent !== null;
    this.axes.visible = layers.axes && !this.riding && this.extent !== null;
    this.draw();
  }

  /**
   * Show another version. The one before stays until the new one is decoded and sorted, so the canvas does not flash; the view
   * stays as it is. The first is waited for until it is drawn. A call followed by a later one does nothing, and returns false.
   */
  async change(changes: Changes): Promise<boolean> {
    const ticket = ++this.loading;
    const grown = changes.slots <= this.capacity ? this.capacity : changes.slots * HEADROOM;
    const capacity = utils.getTextureSize(grown).maxSplats;
    const next = await changed(this.slots, changes, capacity);
    if (ticket !== this.loading) return false;
    this.slots = next;
    if (this.mesh === null || capacity !== this.capacity) this.replaceMesh(capacity);
    else this.refill(this.mesh);
    this.capacity = capacity;
    this.version = changes.version;
    this.splats = next.splats;
    if (this.extent === null && this.splats > 0) this.measure();
    this.show();
    while (this.splats > 0 && this.layers.splats && this.spark.display.numSplats === 0) {
      await moment();
      if (ticket !== this.loading) return false;
    }
    return true;
  }

  private replaceMesh(capacity: number): void {
    const { arrays, slots } = this.slots;
    const splats = new ExtSplats({ extArrays: arrays, numSplats: Math.min(slots, capacity) });
    const mesh = new SplatMesh({ extSplats: splats, raycastable: false });
    const before = this.mesh;
    this.turned.add(mesh); // the service has OpenCV's axes
    this.mesh = mesh;
    before?.removeFromParent();
    before?.dispose();
    if (this.mode !== "colour") showMode(mesh, this.mode, this.depth);
  }

  /** Show another property of the splats. */
  setMode(mode: ViewMode): void {
    if (mode === this.mode) return;
    this.mode = mode;
    if (this.mesh !== null) showMode(this.mesh, mode, this.depth);
    this.draw();
  }

  /** Median distance of the splats from the first pose, 1 before there are any. */
  get depth(): number {
    return this.lead?.depth ?? this.extent?.depth ?? 1;
  }

  /** Give the mesh its new splats: into the textures that it has, and shown when they are sorted. */
  private refill(mesh: SplatMesh): void {
    const splats = mesh.extSplats;
    if (splats === undefined) return;
    splats.extArrays = this.slots.arrays;
    splats.numSplats = this.slots.slots;
    for (const i of [0, 1] as const) {
      splats.textures[i].image.data = this.slots.arrays[i];
      splats.textures[i].needsUpdate = true;
    }
    mesh.updateMappingVersion();
  }

  /** Remove the scene and reset the view. */
  clear(): void {
    this.loading += 1;
    this.mesh?.removeFromParent();
    this.mesh?.dispose();
    this.mesh = null;
    this.slots = NO_SLOTS;
    this.capacity = 0;
    this.version = 0;
    this.splats = 0;
    this.extent = null;
    this.placed = false;
    this.placement = null;
    this.path.clear();
    this.loops.clear();
    this.show();
  }

  private measure(): void {
    const { arrays, slots, held } = this.slots;
    const places = new Float32Array(arrays[0].buffer);
    const heights: number[] = [];
    const distances: number[] = [];
    const eye = this.placement?.position ?? new Vector3();
    for (let slot = 0; slot < slots; slot += Math.max(1, Math.floor(slots / SAMPLE))) {
      if (held[slot] === 0) continue;
      const point = pointOf([...places.subarray(4 * slot, 4 * slot + 3)]);
      heights.push(point.y);
      distances.push(point.distanceTo(eye));
    }
    this.extent = {
      depth: Math.max(quantile(Float32Array.from(distances), 0.5), 1e-6),
      floor: quantile(Float32Array.from(heights), 0.03),
    };
    const { depth } = this.extent;
    this.camera.near = depth / 200;
    this.camera.far = depth * 200;
    this.camera.updateProjectionMatrix();
    this.buildGrid();
    if (this.mesh !== null && this.mode !== "colour") showMode(this.mesh, this.mode, depth);
    this.axes.scale.set(1, -1, -1).multiplyScalar(depth / 8);
    if (this.placed) return;
    this.home();
  }

  private buildGrid(): void {
    this.world.remove(this.grid);
    this.grid.dispose();
    const { depth } = this;
    const cell = roundLength(depth / 6);
    const cells = 2 * Math.ceil((1.6 * depth) / cell);
    this.grid = new GridHelper(cells * cell, cells, this.gridColour, this.gridColour);
    this.grid.position.y = this.extent?.floor ?? 0;
    this.grid.visible = this.layers.grid && !this.riding && this.extent !== null;
    this.world.add(this.grid);
  }

  setPath(path: Path, by: Colouring): void {
    this.path.set(path, by);
    this.show();
  }

  setLoops(path: Path, closures: readonly Closure[], fresh: number): void {
    this.loops.set(path, closures, this.depth * LOOP_SIZE, fresh);
    this.show();
  }

  /** Pose of the capture camera at the shown frame. */
  setPose(position: readonly number[], wxyz: readonly number[], sensor: Sensor): void {
    this.placement = placementOf(position, wxyz);
    this.sensor = sensor;
    this.frustum.position.copy(this.placement.position);
    this.frustum.quaternion.copy(this.placement.quaternion);
    this.rider.position.copy(this.placement.position);
    this.rider.quaternion.copy(this.placement.quaternion);
    this.rider.updateMatrixWorld();
    const k = sensor.intrinsics;
    if (k !== null) {
      const { depth } = this;
      this.rider.projectionMatrix.copy(projectionOf(k, sensor.width, sensor.height, depth / 200, depth * 200));
      this.rider.projectionMatrixInverse.copy(this.rider.projectionMatrix).invert();
      const size = depth / 8;
      const corners = [
        [0, 0],
        [sensor.width, 0],
        [sensor.width, sensor.height],
        [0, sensor.height],
      ].map(([x = 0, y = 0]) => new Vector3(((x - k.cx) / k.fx) * size, (-(y - k.cy) / k.fy) * size, -size));
      const apex = new Vector3();
      const [a = apex, b = apex, c = apex, d = apex] = corners;
      const top = a.clone().lerp(b, 0.5);
      const peak = top.clone().add(new Vector3(0, 0.16 * (a.y - d.y), 0)); // tells up from down
      const left = top.clone().lerp(a, 0.4);
      const right = top.clone().lerp(b, 0.4);
      const edges = [apex, a, apex, b, apex, c, apex, d, a, b, b, c, c, d, d, a, left, peak, peak, right];
      this.frustum.geometry.dispose();
      this.frustum.geometry = new LineSegmentsGeometry();
      this.frustum.geometry.setPositions(edges.flatMap((p) => p.toArray()));
    }
    if (!this.placed && this.extent !== null) this.home();
    this.show();
  }

  setRiding(riding: boolean): void {
    this.riding = riding;
    this.steer(this.steering);
    this.show();
  }

  steer(steering: Steering): void {
    if (this.steering === "fly" && steering === "orbit") this.orbit.target.copy(this.ahead());
    this.steering = steering;
    this.orbit.enabled = steering === "orbit" && !this.riding;
    this.flyWhileFocused();
    this.draw();
  }

  /** Keys fly only while the canvas has the focus: keys typed elsewhere are not handled. */
  private readonly flyWhileFocused = (): void => {
    this.fly?.dispose();
    this.fly = null;
    if (this.steering !== "fly" || this.riding || document.activeElement !== this.canvas) return;
    this.fly = new FlyControls(this.camera, this.canvas);
    this.fly.dragToLook = true;
    this.fly.movementSpeed = this.depth / 2;
    this.fly.rollSpeed = 0.6;
    this.draw();
  };

  /** A point in front of the free camera, at the distance of the scene. */
  private ahead(): Vector3 {
    const reach = this.depth;
    return this.camera.position.clone().addScaledVector(this.camera.getWorldDirection(new Vector3()), reach);
  }

  /** Initial view: behind and slightly above the capture camera. */
  home(): void {
    const { depth } = this;
    const at = this.placement ?? { position: new Vector3(), quaternion: new Quaternion() };
    const offset = new Vector3(0.22 * depth, 0.22 * depth, 0.6 * depth).applyQuaternion(at.quaternion);
    this.camera.position.copy(at.position).add(offset);
    this.orbit.target.copy(at.position).add(new Vector3(0, 0, -0.7 * depth).applyQuaternion(at.quaternion));
    this.placed = this.placement !== null; // else once more when the path has come
    this.orbit.update();
    this.draw();
  }

  /** Show the scene in a headset until that is put away. */
  async enterVr(): Promise<void> {
    const { renderer, world, content, spark, depth } = this;
    const ahead = this.camera.getWorldDirection(new Vector3());
    this.presenting = true;
    try {
      await showInHeadset({ renderer, world, content, drawer: spark, eye: this.eye, ahead, depth });
    } finally {
      this.presenting = false;
      if (!this.disposed) {
        this.renderer.setPixelRatio(this.sharpness);
        this.resize();
        this.show();
      }
    }
  }

  /** Look at the scene from one of its sides, from as far as now. */
  look(preset: Preset): void {
    if (preset === "camera" && this.placement !== null) {
      const { position, quaternion } = this.placement;
      this.camera.position.copy(position);
      this.orbit.target.copy(position).add(new Vector3(0, 0, -this.depth).applyQuaternion(quaternion));
    } else {
      const { target } = this.orbit;
      const away = this.camera.position.distanceTo(target);
      this.camera.position.copy(target).addScaledVector(presetDirection(preset), away);
    }
    this.moved();
  }

  /** Vertical field of view of the free camera, degrees. */
  setFov(fov: number): void {
    this.camera.fov = fov;
    this.camera.updateProjectionMatrix();
    this.moved();
  }

  /** Turn to the point of the scene under a place of the window, and go round it from now on; false if nothing is there. */
  focus(clientX: number, clientY: number): boolean {
    const point = this.pick(clientX, clientY);
    if (point === null) return false;
    this.orbit.target.copy(point);
    this.moved();
    return true;
  }

  /** The point of the scene under a place of the window, in the axes of three.js; null if nothing opaque is there. */
  pick(clientX: number, clientY: number): Vector3 | null {
    const box = this.canvas.getBoundingClientRect();
    const at = new Vector2(((clientX - box.left) / box.width) * 2 - 1, 1 - ((clientY - box.top) / box.height) * 2);
    const caster = new Raycaster();
    caster.setFromCamera(at, this.riding ? this.rider : this.camera);
    const { origin, direction } = caster.ray;
    const turned = (v: Vector3): Vector3 => new Vector3(v.x, -v.y, -v.z);
    const distance = distanceAlong(this.slots, turned(origin), turned(direction));
    return distance === null ? null : origin.clone().addScaledVector(direction, distance);
  }

  /** Mark points with crosses, joined by lines. */
  mark(points: readonly Vector3[], closed: boolean): void {
    this.marks.set(points, this.depth * MARK_SIZE, closed);
    this.draw();
  }

  /** The middle of the canvas, as a place of the window. */
  get middle(): [number, number] {
    const box = this.canvas.getBoundingClientRect();
    return [box.left + box.width / 2, box.top + box.height / 2];
  }

  /** The box around all splats, in the axes of the scene; null before there are any. Found once for each change. */
  bounds(): Box | null {
    if (this.bounded?.slots !== this.slots) this.bounded = { slots: this.slots, box: this.findBounds() };
    return this.bounded.box;
  }

  private findBounds(): Box | null {
    const { arrays, slots, held } = this.slots;
    const places = new Float32Array(arrays[0].buffer);
    const low: [number, number, number] = [Infinity, Infinity, Infinity];
    const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
    for (let slot = 0; slot < slots; slot += 1) {
      if (held[slot] === 0) continue;
      for (const k of [0, 1, 2] as const) {
        const x = places[4 * slot + k] ?? 0;
        low[k] = Math.min(low[k], x);
        high[k] = Math.max(high[k], x);
      }
    }
    return low[0] > high[0] ? null : { low, high };
  }

  /** What lies behind a line on the canvas, in pixels from its corner; null while another camera is looked through. */
  outline(line: readonly Point[]): { outline: Outline; splats: number } | null {
    if (this.riding) return null;
    const { clientWidth, clientHeight } = this.canvas;
    const outline = outlineOf(line, clientWidth, clientHeight, this.camera);
    return { outline, splats: countInside(this.slots, outline) };
  }

  /** Draw the edges of a box; null: none. */
  showBox(box: Box | null): void {
    if (box !== null) this.crop.box.setFromPoints([pointOf(box.low), pointOf(box.high)]);
    this.crop.visible = box !== null;
    this.draw();
  }

  /** Where the free camera is. */
  get eye(): Vector3 {
    return this.camera.position.clone();
  }

  /** The length that a pixel covers at the mean distance of points, in units of the scene. */
  pixel(points: readonly Vector3[]): number {
    const away = points.reduce((sum, point) => sum + point.distanceTo(this.camera.position), 0) / points.length;
    return (2 * away * Math.tan((this.camera.fov * Math.PI) / 360)) / Math.max(this.canvas.clientHeight, 1);
  }

  private moved(): void {
    this.placed = true;
    this.orbit.update();
    this.draw();
    this.onMoved();
  }

  /** Position and target of the free camera and its field of view in degrees: seven numbers, for URLs and bookmarks. */
  view(): number[] {
    const target = this.steering === "fly" ? this.ahead() : this.orbit.target;
    return [...this.camera.position.toArray(), ...target.toArray(), this.camera.fov];
  }

  setView(view: readonly number[]): void {
    this.camera.position.fromArray(view.slice(0, 3));
    this.orbit.target.fromArray(view.slice(3, 6));
    this.camera.fov = Math.min(Math.max(view[6] ?? 55, 5), 120);
    this.camera.updateProjectionMatrix();
    this.placed = true;
    this.orbit.update();
    this.draw();
  }

  /** Have the free camera of another viewer from now on, whichever of both is moved. */
  follow(lead: Viewer): void {
    this.lead = lead;
    lead.follower = this;
    this.takeCamera(lead);
  }

  private takeCamera(from: Viewer): void {
    const { camera, orbit } = from;
    const same =
      this.camera.matrix.equals(camera.matrix) &&
      this.orbit.target.equals(orbit.target) &&
      this.camera.fov === camera.fov &&
      this.camera.near === camera.near;
    if (same) return;
    this.camera.position.copy(camera.position);
    this.camera.quaternion.copy(camera.quaternion);
    this.camera.updateMatrix();
    this.orbit.target.copy(orbit.target);
    this.camera.fov = camera.fov;
    this.camera.near = camera.near;
    this.camera.far = camera.far;
    this.camera.updateProjectionMatrix();
    this.placed = true;
    if (from.resting !== undefined && this.lead === null) this.moves();
    this.draw();
  }

  /** Show the scene and its path moved, turned and scaled. */
  align(by: Matrix4): void {
    by.decompose(this.content.position, this.content.quaternion, this.content.scale);
    this.draw();
  }

  /** The view as a PNG file of a size, see `sizeOf`. Throws for one that cannot be drawn. */
  picture(size: Size): Promise<Blob> {
    const { width, height } = this.sizeOf(size);
    const { maxPixelRadius } = this.spark;
    try {
      this.spark.maxPixelRadius = (maxPixelRadius * height) / Math.max(this.canvas.height, 1);
      this.renderer.setPixelRatio(1);
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
      const { drawingBufferWidth, drawingBufferHeight } = this.renderer.getContext();
      if (drawingBufferWidth !== width || drawingBufferHeight !== height)
        throw new Error(`This browser draws no picture of ${width} × ${height}: choose a smaller one.`);
      return this.drawn(height);
    } finally {
      this.spark.maxPixelRadius = maxPixelRadius;
      this.coarse = false;
      this.renderer.setPixelRatio(this.sharpness);
      this.resize();
    }
  }

  /** Pixels of the canvas for one of the style sheets. */
  get sharpness(): number {
    return Math.min(window.devicePixelRatio, MOST_SHARPNESS);
  }

  private drawn(height: number): Promise<Blob> {
    const camera = this.riding ? this.rider : this.camera;
    this.path.dashFor(camera, height);
    this.renderer.render(this.world, camera);
    return new Promise((resolve, reject) => {
      this.canvas.toBlob((blob) => (blob === null ? reject(new Error("The canvas gave no picture.")) : resolve(blob)));
    });
  }

  /** The size of a picture: while riding along, its height follows from the width. */
  sizeOf({ width, height }: Size): Size {
    const shape = this.riding && this.sensor !== null ? this.sensor.height / this.sensor.width : height / width;
    return { width, height: Math.round(width * shape) };
  }
}
