/** Conversion of axes, used everywhere: the service has OpenCV axes (x right, y down, z forward), three.js has y up. */

import { Matrix4, Quaternion, Vector3 } from "three";

import type { Intrinsics } from "../../shared/api/types";

/** Half a turn about x: OpenCV's world into that of three.js, and back. */
const HALF_TURN = new Quaternion(1, 0, 0, 0);

export interface Placement {
  position: Vector3;
  quaternion: Quaternion;
}

export const pointOf = (p: readonly number[]): Vector3 => new Vector3(p[0], -(p[1] ?? 0), -(p[2] ?? 0));

/** A camera-to-world pose for an object of three.js, whose cameras look along -z with y up. */
export function placementOf(position: readonly number[], wxyz: readonly number[]): Placement {
  const [w = 1, x = 0, y = 0, z = 0] = wxyz;
  const turned = HALF_TURN.clone()
    .multiply(new Quaternion(x, y, z, w))
    .multiply(HALF_TURN.clone().invert());
  return { position: pointOf(position), quaternion: turned.normalize() };
}

/** A pose in the axes of the service. */
export interface ServicePose {
  position: [number, number, number];
  quaternion_wxyz: [number, number, number, number];
}

/** The inverse of `placementOf`. */
export function poseOf({ position, quaternion }: Placement): ServicePose {
  const turned = HALF_TURN.clone().invert().multiply(quaternion).multiply(HALF_TURN);
  return {
    position: [position.x, -position.y, -position.z],
    quaternion_wxyz: [turned.w, turned.x, turned.y, turned.z],
  };
}

/** The pose of a view as `Viewer.view` gives it: position and target, upright. */
export function poseOfView(view: readonly number[]): ServicePose {
  const position = new Vector3(...view.slice(0, 3));
  const looking = new Matrix4().lookAt(position, new Vector3(...view.slice(3, 6)), new Vector3(0, 1, 0));
  return poseOf({ position, quaternion: new Quaternion().setFromRotationMatrix(looking) });
}

/** Projection of a pinhole camera whose principal point need not be the image centre. */
export function projectionOf(k: Intrinsics, width: number, height: number, near: number, far: number): Matrix4 {
  const left = (-k.cx / k.fx) * near;
  const right = ((width - k.cx) / k.fx) * near;
  const top = (k.cy / k.fy) * near;
  const bottom = (-(height - k.cy) / k.fy) * near;
  return new Matrix4().makePerspective(left, right, top, bottom, near, far);
}
