/** The scene in a headset: the reader stands where the free camera is, and the scene is as deep as a room. */

import {
  type Group,
  type Object3D,
  PerspectiveCamera,
  Quaternion,
  type Scene,
  Vector3,
  type WebGLRenderer,
} from "three";

/** How far away the middle of the scene is in a headset, metres: its own unit of length is none. */
const DEPTH_M = 2;
/** Nearest and farthest distance that is drawn, metres. */
const [NEAR_M, FAR_M] = [0.05, 200];

/** Whether a headset is there that this browser can show scenes on; needs a secure context. */
export async function headsetFound(): Promise<boolean> {
  const { xr } = navigator as { xr?: XRSystem };
  try {
    return (await xr?.isSessionSupported("immersive-vr")) ?? false;
  } catch {
    return false; // the page is not allowed to know
  }
}

export interface Stage {
  renderer: WebGLRenderer;
  world: Scene;
  /** What is shown in the headset; all else of the world is hidden. */
  content: Group;
  /** What draws the content, and has to stay visible. */
  drawer: Object3D;
  /** Where the free camera is. */
  eye: Vector3;
  /** Where it looks. */
  ahead: Vector3;
  /** Distance of the middle of the scene. */
  depth: number;
}

/** Show the scene in a headset until its session ends; throws if the headset refuses. */
export async function showInHeadset(stage: Stage): Promise<void> {
  const { renderer, world, content, drawer } = stage;
  const { xr } = navigator as { xr?: XRSystem };
  if (xr === undefined) throw new Error("This browser has no access to a headset.");
  const session = await xr.requestSession("immersive-vr");
  const ended = sessionEnd(renderer);
  const hidden = world.children.filter((one) => one.visible && one !== content && one !== drawer);
  const before = { place: content.position.clone(), turn: content.quaternion.clone(), size: content.scale.clone() };
  const camera = new PerspectiveCamera(55, 1, NEAR_M, FAR_M);
  try {
    for (const one of hidden) one.visible = false;
    // Upright, whatever the camera looks up or down: the head does that.
    const level = new Vector3(stage.ahead.x, 0, stage.ahead.z).normalize();
    const turn = new Quaternion().setFromUnitVectors(level, new Vector3(0, 0, -1));
    const size = DEPTH_M / stage.depth;
    content.quaternion.copy(turn);
    content.scale.setScalar(size);
    content.position.copy(stage.eye).applyQuaternion(turn).multiplyScalar(-size);
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType("local");
    try {
      await renderer.xr.setSession(session);
    } catch (error) {
      await session.end(); // else the headset shows nothing until it is put away
      throw error;
    }
    renderer.setAnimationLoop(() => renderer.render(world, camera));
    await ended;
  } finally {
    renderer.setAnimationLoop(null);
    renderer.xr.enabled = false;
    for (const one of hidden) one.visible = true;
    content.position.copy(before.place);
    content.quaternion.copy(before.turn);
    content.scale.copy(before.size);
  }
}

/** The end of the next session, after three.js has restored its own state: it sets size and loop of the renderer. */
function sessionEnd({ xr }: WebGLRenderer): Promise<void> {
  return new Promise((resolve) => {
    const onEnd = (): void => {
      xr.removeEventListener("sessionend", onEnd);
      resolve();
    };
    xr.addEventListener("sessionend", onEnd);
  });
}
