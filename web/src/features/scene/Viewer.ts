/** The scene on a canvas: Gaussians by Spark, path, frustum, grid and axes by three.js. Draws only after changes. */

import { ExtSplats, SparkRenderer, SplatMesh, utils } from "@sparkjsdev/spark";
import {
  AxesHelper,
  Color,
  GridHelper,
  Group,
  PerspectiveCamera,
  Quaternion,
  Scene,
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
import { type Colouring, type Path, quantile } from "./path";
import { LoopLines } from "./loops";
import { OVERLAY_ORDER, PathLines } from "./PathLines";

export type Steering = "orbit" | "fly";

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
const SAMPLE = 20_000;
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

export class Viewer {
  /** Version of the scene that is shown; 0 before the first. */
  version = 0;
  splats = 0;
  private readonly renderer: WebGLRenderer;
  private readonly world = new Scene();
  /** Parent of objects in OpenCV axes. */
  private readonly turned = new Group();
  private readonly spark: SparkRenderer;
  private readonly camera = new PerspectiveCamera(55, 1, 0.01, 1000);
  private readonly rider = new PerspectiveCamera();
  private readonly orbit: OrbitControls;
  private fly: FlyControls | null = null;
  private steering: Steering = "orbit";
  private mesh: SplatMesh | null = null;
  private slots: Slots = NO_SLOTS;
  /** Splats for which the textures have room. */
  private capacity = 0;
  private readonly path = new PathLines();
  private readonly loops = new LoopLines();
  private readonly frustum = new LineSegments2(new LineSegmentsGeometry(), new LineMaterial({ linewidth: FRUSTUM_PX }));
  private grid = new GridHelper(1, 1);
  private readonly gridColour = new Color();
  private readonly axes = new AxesHelper(1);
  private layers: Layers = { splats: true, path: true, loops: true, frustum: true, grid: true, axes: true };
  private extent: Extent | null = null;
  private placement: Placement | null = null;
  private sensor: Sensor | null = null;
  private riding = false;
  private placed = false;
  private scheduled = 0;
  private lastMs = 0;
  private loading = 0;
  private readonly resizing: ResizeObserver;

  /** @param onMoved called when the user has moved the camera. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onMoved: () => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
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
    this.world.add(this.spark, this.turned, this.path, this.loops, this.frustum, this.axes);
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
    // Of the capture's world, OpenCV's: y points down and z ahead.
    this.axes.scale.set(1, -1, -1);
    this.axes.setColors(new Color(colour("axis-x")), new Color(colour("axis-y")), new Color(colour("axis-z")));
    const names = axisNames();
    names.scale.set(1, -1, -1);
    this.axes.add(names);
    this.axes.visible = false;
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.addEventListener("change", () => this.draw());
    this.orbit.addEventListener("end", () => {
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
    this.resize();
  }

  dispose(): void {
    cancelAnimationFrame(this.scheduled);
    this.resizing.disconnect();
    this.orbit.dispose();
    this.fly?.dispose();
    this.canvas.removeEventListener("focus", this.flyWhileFocused);
    this.canvas.removeEventListener("blur", this.flyWhileFocused);
    this.mesh?.dispose();
    this.path.clear();
    this.loops.clear();
    this.canvas.removeEventListener("webglcontextlost", this.onLost);
    this.canvas.removeEventListener("webglcontextrestored", this.draw);
    this.renderer.dispose();
  }

  /** Draw in the next animation frame, once for any number of calls. */
  readonly draw = (): void => {
    if (this.scheduled === 0) this.scheduled = requestAnimationFrame(this.render);
  };

  private readonly onLost = (event: Event): void => event.preventDefault();

  private readonly render = (nowMs: number): void => {
    this.scheduled = 0;
    const elapsed = Math.min((nowMs - this.lastMs) / 1000, 0.1);
    this.lastMs = nowMs;
    if (this.fly !== null) {
      const before = this.camera.matrix.elements.slice();
      this.fly.update(elapsed);
      this.camera.updateMatrix();
      if (this.camera.matrix.elements.some((value, i) => value !== before[i])) this.onMoved();
      this.draw(); // keys are held between events
    }
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
   * stays as it is. A call followed by a later one does nothing, and returns false.
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
    this.axes.scale.set(1, -1, -1).multiplyScalar(depth / 8);
    if (this.placed) return;
    this.home();
  }

  private buildGrid(): void {
    this.world.remove(this.grid);
    this.grid.dispose();
    const depth = this.extent?.depth ?? 1;
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
    this.loops.set(path, closures, (this.extent?.depth ?? 1) * LOOP_SIZE, fresh);
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
      const depth = this.extent?.depth ?? 1;
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
    this.fly.movementSpeed = (this.extent?.depth ?? 1) / 2;
    this.fly.rollSpeed = 0.6;
    this.draw();
  };

  /** A point in front of the free camera, at the distance of the scene. */
  private ahead(): Vector3 {
    const reach = this.extent?.depth ?? 1;
    return this.camera.position.clone().addScaledVector(this.camera.getWorldDirection(new Vector3()), reach);
  }

  /** Initial view: behind and slightly above the capture camera. */
  home(): void {
    const depth = this.extent?.depth ?? 1;
    const at = this.placement ?? { position: new Vector3(), quaternion: new Quaternion() };
    const offset = new Vector3(0.22 * depth, 0.22 * depth, 0.6 * depth).applyQuaternion(at.quaternion);
    this.camera.position.copy(at.position).add(offset);
    this.orbit.target.copy(at.position).add(new Vector3(0, 0, -0.7 * depth).applyQuaternion(at.quaternion));
    this.placed = this.placement !== null; // else once more when the path has come
    this.orbit.update();
    this.draw();
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

  /** The canvas as a PNG file. */
  picture(): Promise<Blob> {
    this.renderer.render(this.world, this.riding ? this.rider : this.camera);
    return new Promise((resolve, reject) => {
      this.canvas.toBlob((blob) => (blob === null ? reject(new Error("The canvas gave no picture.")) : resolve(blob)));
    });
  }
}
