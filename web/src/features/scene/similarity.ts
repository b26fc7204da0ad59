/** Similarities between paths: rotation, translation and scale, and how far apart the paths are after them. */

import { Matrix4, Quaternion, Vector3 } from "three";

import { placementOf } from "./axes";
import { type Path, rowAtTime } from "./path";

/** Maps a point p to scale * rotation p + translation; OpenCV axes. */
export interface Similarity {
  scale: number;
  rotation: Quaternion;
  translation: Vector3;
}

export const IDENTITY: Similarity = { scale: 1, rotation: new Quaternion(), translation: new Vector3() };

/** Fewer common poses than this give no similarity. */
const LEAST_POSES = 3;
/** Positions are interpolated between poses that are at most so many usual intervals apart. */
const MOST_INTERVALS = 5;

/** Places and orientations of two paths at the same times. */
interface Pairs {
  from: Vector3[];
  to: Vector3[];
  fromTurns: Quaternion[];
  toTurns: Quaternion[];
}

const positionAt = (path: Path, row: number): Vector3 => new Vector3().fromArray(path.positions, 3 * row);

function turnAt(path: Path, row: number): Quaternion {
  const [w = 1, x = 0, y = 0, z = 0] = path.quaternions.subarray(4 * row, 4 * row + 4);
  return new Quaternion(x, y, z, w);
}

function usualInterval(path: Path): number {
  const steps = path.times.slice(1).map((time, i) => time - (path.times[i] ?? 0));
  return steps.sort()[steps.length >> 1] ?? 0;
}

/** Where a path is at a time, interpolated; null outside of it and in its gaps. */
function interpolated(path: Path, time_s: number, interval_s: number): Vector3 | null {
  const near = rowAtTime(path, time_s);
  const nearTime = path.times[near];
  if (nearTime === undefined) return null;
  if (Math.abs(nearTime - time_s) < 1e-9) return positionAt(path, near);
  const other = nearTime < time_s ? near + 1 : near - 1;
  const otherTime = path.times[other];
  if (otherTime === undefined || Math.abs(otherTime - nearTime) > MOST_INTERVALS * interval_s) return null;
  return positionAt(path, near).lerp(positionAt(path, other), (time_s - nearTime) / (otherTime - nearTime));
}

function paired(from: Path, to: Path): Pairs {
  const pairs: Pairs = { from: [], to: [], fromTurns: [], toTurns: [] };
  const interval_s = usualInterval(to);
  for (const [row, time_s] of from.times.entries()) {
    const place = interpolated(to, time_s, interval_s);
    if (place === null) continue;
    pairs.from.push(positionAt(from, row));
    pairs.to.push(place);
    pairs.fromTurns.push(turnAt(from, row));
    pairs.toTurns.push(turnAt(to, rowAtTime(to, time_s)));
  }
  return pairs;
}

const mean = (points: readonly Vector3[]): Vector3 =>
  points.reduce((sum, point) => sum.add(point), new Vector3()).divideScalar(Math.max(points.length, 1));

/** The eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix, by squaring it until only that one is left. */
function largestEigenvector(symmetric: Matrix4): [number, number, number, number] {
  const size = Math.hypot(...symmetric.elements);
  const power = symmetric.clone();
  for (const i of [0, 5, 10, 15] as const) power.elements[i] += size; // none is negative now
  for (let i = 0; i < 40; i += 1) {
    power.multiplyScalar(1 / Math.max(Math.hypot(...power.elements), 1e-300));
    power.multiply(power.clone());
  }
  const columns = [0, 4, 8, 12].map((at) => power.elements.slice(at, at + 4));
  const [best = [1, 0, 0, 0]] = columns.sort((a, b) => Math.hypot(...b) - Math.hypot(...a));
  const [a = 1, b = 0, c = 0, d = 0] = best;
  const length = Math.hypot(a, b, c, d);
  return [a / length, b / length, c / length, d / length];
}

type Axis = "x" | "y" | "z";

/** The rotation between places around their means: Horn, Closed-form solution of absolute orientation, 1987. */
function rotationOfPlaces(from: readonly Vector3[], to: readonly Vector3[]): Quaternion {
  const sum = (r: Axis, c: Axis): number => from.reduce((all, p, i) => all + p[r] * (to[i] ?? p)[c], 0);
  const [xx, xy, xz] = [sum("x", "x"), sum("x", "y"), sum("x", "z")];
  const [yx, yy, yz] = [sum("y", "x"), sum("y", "y"), sum("y", "z")];
  const [zx, zy, zz] = [sum("z", "x"), sum("z", "y"), sum("z", "z")];
  // prettier-ignore
  const n = new Matrix4().set(
    xx + yy + zz, yz - zy,       zx - xz,       xy - yx,
    yz - zy,      xx - yy - zz,  xy + yx,       zx + xz,
    zx - xz,      xy + yx,       yy - xx - zz,  yz + zy,
    xy - yx,      zx + xz,       yz + zy,       zz - xx - yy,
  );
  const [w, x, y, z] = largestEigenvector(n);
  return new Quaternion(x, y, z, w);
}

/** The mean rotation between orientations: Markley and others, Averaging quaternions, 2007. */
function rotationOfTurns(from: readonly Quaternion[], to: readonly Quaternion[]): Quaternion {
  const sum = new Array<number>(16).fill(0);
  for (const [i, turn] of from.entries()) {
    const between = (to[i] ?? turn).clone().multiply(turn.clone().invert()).toArray();
    between.forEach((a, r) => between.forEach((b, c) => (sum[4 * r + c] = (sum[4 * r + c] ?? 0) + a * b)));
  }
  return new Quaternion(...largestEigenvector(new Matrix4().fromArray(sum)));
}

/**
 * The similarity that brings a path nearest to another, over their common times; null if they have too few.
 *
 * @param by what gives the rotation: the places, as is usual for the error against a truth, or the orientations, which are
 * enough on a straight path, too, but have to be of the same camera.
 */
export function similarityOf(from: Path, to: Path, by: "places" | "turns"): Similarity | null {
  const pairs = paired(from, to);
  if (pairs.from.length < LEAST_POSES) return null;
  const [fromMean, toMean] = [mean(pairs.from), mean(pairs.to)];
  const a = pairs.from.map((p) => p.clone().sub(fromMean));
  const b = pairs.to.map((p) => p.clone().sub(toMean));
  const rotation = by === "places" ? rotationOfPlaces(a, b) : rotationOfTurns(pairs.fromTurns, pairs.toTurns);
  const spread = a.reduce((sum, p) => sum + p.lengthSq(), 0);
  const common = a.reduce(
    (sum, p, i) =>
      sum +
      p
        .clone()
        .applyQuaternion(rotation)
        .dot(b[i] ?? p),
    0,
  );
  const scale = spread > 0 && common > 0 ? common / spread : 1;
  return {
    scale,
    rotation,
    translation: toMean.sub(fromMean.applyQuaternion(rotation).multiplyScalar(scale)),
  };
}

export const applied = ({ scale, rotation, translation }: Similarity, point: Vector3): Vector3 =>
  point.clone().applyQuaternion(rotation).multiplyScalar(scale).add(translation);

export function inverse({ scale, rotation, translation }: Similarity): Similarity {
  const back = rotation.clone().invert();
  return {
    scale: 1 / scale,
    rotation: back,
    translation: translation
      .clone()
      .applyQuaternion(back)
      .multiplyScalar(-1 / scale),
  };
}

/** Root mean square of the distances of a path, mapped, from another at the same times; null if they have none. */
export function rmsDistance(from: Path, to: Path, by: Similarity): number | null {
  const pairs = paired(from, to);
  if (pairs.from.length === 0) return null;
  const squares = pairs.from.reduce((sum, p, i) => sum + applied(by, p).distanceToSquared(pairs.to[i] ?? p), 0);
  return Math.sqrt(squares / pairs.from.length);
}

/** A similarity in the axes of three.js. */
export function matrixOf({ scale, rotation, translation }: Similarity): Matrix4 {
  const { x, y, z, w } = rotation;
  const { position, quaternion } = placementOf(translation.toArray(), [w, x, y, z]);
  return new Matrix4().compose(position, quaternion, new Vector3(scale, scale, scale));
}

/** A path of TUM's format: `time x y z qx qy qz qw` a line. Throws an error that names the first line that is none. */
export function pathOfTum(text: string, frameRateHz: number): Path {
  const rows: number[][] = [];
  for (const [i, line] of text.split(/\r?\n/).entries()) {
    if (line.trim() === "" || line.trimStart().startsWith("#")) continue;
    const row = line
      .trim()
      .split(/[\s,]+/)
      .map(Number);
    if (row.length !== 8 || !row.every(Number.isFinite))
      throw new Error(
        `Line ${i + 1} is no pose. A TUM file has “time x y z qx qy qz qw” a line, in seconds and metres.`,
      );
    rows.push(row);
  }
  if (rows.length < LEAST_POSES)
    throw new Error(`The file has ${rows.length} poses; at least ${LEAST_POSES} are needed.`);
  rows.sort((a, b) => (a[0] ?? 0) - (b[0] ?? 0));
  return {
    times: Float64Array.from(rows, (row) => row[0] ?? 0),
    frames: Float64Array.from(rows, (row) => Math.round((row[0] ?? 0) * frameRateHz - 0.5)),
    positions: Float32Array.from(rows.flatMap((row) => row.slice(1, 4))),
    quaternions: Float32Array.from(rows.flatMap(([, , , , x = 0, y = 0, z = 0, w = 1]) => [w, x, y, z])),
    states: rows.map(() => null),
  };
}
