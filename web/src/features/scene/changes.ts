/** Changes of a scene (docs/api.md): reads the message, and writes its splats into the arrays that Spark draws from. */

import { utils } from "@sparkjsdev/spark";
import { DataUtils } from "three";

const MAGIC = 0x434b5053;
const HEADER_WORDS = 10;
/** Words of a splat in each of Spark's two arrays. */
const WORDS = 4;
/** Rows written before other work of the page has a turn: some milliseconds. */
const ROWS_A_TURN = 8192;
/** Magnifications of the splats at each level of detail: the root of the share that is shown. */
const MAGNIFICATIONS = [4, 2, 1];

export interface Changes {
  whole: boolean;
  /** What the next changes are asked for with; null: with nothing. */
  state: string | null;
  version: number;
  level: number;
  slots: number;
  emptied: Uint32Array;
  filled: Uint32Array;
  /** [3 n] OpenCV axes. */
  means: Float32Array;
  /** [3 n] 16-bit floats. */
  logScales: Uint16Array;
  /** [channels n] 16-bit floats. */
  colours: Uint16Array;
  /** [4 n] wxyz. */
  quats: Int8Array;
  opacities: Uint8Array;
}

export function readChanges(raw: ArrayBuffer): Changes {
  const head = new Uint32Array(raw, 0, Math.min(HEADER_WORDS, raw.byteLength >> 2));
  const [magic, format, whole, began = 0, version = 0, level = 0, slots = 0, channels = 1, m = 0, n = 0] = head;
  if (magic !== MAGIC || format !== 1) throw new Error("The service sent something else than a scene.");
  let at = HEADER_WORDS * 4;
  const take = <T>(kind: new (buffer: ArrayBuffer, at: number, count: number) => T, count: number, size: number): T => {
    const column = new kind(raw, at, count);
    at += count * size;
    return column;
  };
  return {
    whole: whole === 1,
    state: began === 0 ? null : `${began}-${version}-${level}`,
    version,
    level,
    slots,
    emptied: take(Uint32Array, m, 4),
    filled: take(Uint32Array, n, 4),
    means: take(Float32Array, 3 * n, 4),
    logScales: take(Uint16Array, 3 * n, 2),
    colours: take(Uint16Array, channels * n, 2),
    quats: take(Int8Array, 4 * n, 1),
    opacities: take(Uint8Array, n, 1),
  };
}

/** The splats of a scene by their slots, packed as Spark's `ExtSplats` are. Empty slots have no opacity. */
export interface Slots {
  arrays: [Uint32Array, Uint32Array];
  slots: number;
  held: Uint8Array;
  splats: number;
}

export const NO_SLOTS: Slots = {
  arrays: [new Uint32Array(), new Uint32Array()],
  slots: 0,
  held: new Uint8Array(),
  splats: 0,
};

/** The slots after the changes, in arrays of their own with room for `capacity` splats; those before stay as they are. */
export async function changed(before: Slots, changes: Changes, capacity: number): Promise<Slots> {
  const first = new Uint32Array(WORDS * capacity);
  const second = new Uint32Array(WORDS * capacity);
  const held = new Uint8Array(changes.slots);
  if (!changes.whole) {
    const words = WORDS * Math.min(before.slots, changes.slots);
    first.set(before.arrays[0].subarray(0, words));
    second.set(before.arrays[1].subarray(0, words));
    held.set(before.held.subarray(0, changes.slots));
  }
  const { emptied, filled } = changes;
  for (const slot of emptied) {
    held[slot] = 0;
    first[WORDS * slot + 3] = 0;
  }
  for (let from = 0; from < filled.length; from += ROWS_A_TURN) {
    if (from > 0) await new Promise((resolve) => setTimeout(resolve));
    write(first, second, changes, from, Math.min(from + ROWS_A_TURN, filled.length));
  }
  for (const slot of filled) held[slot] = 1;
  return { arrays: [first, second], slots: changes.slots, held, splats: held.reduce((sum, one) => sum + one, 0) };
}

const HALF_OF_BYTE = Uint16Array.from({ length: 256 }, (_, byte) => DataUtils.toHalfFloat(byte / 255));

function write(first: Uint32Array, second: Uint32Array, changes: Changes, from: number, to: number): void {
  const { filled, means, logScales, colours, quats, opacities } = changes;
  const places = new Float32Array(first.buffer);
  const channels = colours.length === filled.length ? 1 : 3;
  const magnification = MAGNIFICATIONS[changes.level] ?? 1;
  const grown = Math.log(magnification);
  const scale = (half: number): number =>
    magnification === 1 ? half : DataUtils.toHalfFloat(DataUtils.fromHalfFloat(half) + grown);
  for (let row = from; row < to; row += 1) {
    const at = WORDS * (filled[row] ?? 0);
    const three = 3 * row;
    for (let k = 0; k < 3; k += 1) places[at + k] = means[three + k] ?? 0;
    first[at + 3] = HALF_OF_BYTE[opacities[row] ?? 0] ?? 0;
    const red = colours[channels * row] ?? 0;
    const green = channels === 1 ? red : (colours[three + 1] ?? 0);
    const blue = channels === 1 ? red : (colours[three + 2] ?? 0);
    second[at] = red | (green << 16);
    second[at + 1] = blue | (scale(logScales[three] ?? 0) << 16);
    second[at + 2] = scale(logScales[three + 1] ?? 0) | (scale(logScales[three + 2] ?? 0) << 16);
    const four = 4 * row;
    const [w, x, y, z] = [quats[four] ?? 0, quats[four + 1] ?? 0, quats[four + 2] ?? 0, quats[four + 3] ?? 0];
    const turned = w !== 0 || x !== 0 || y !== 0 || z !== 0;
    second[at + 3] = utils.encodeQuatOctXy1010R12(x, y, z, turned ? w : 1);
  }
}
