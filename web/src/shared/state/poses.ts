/** Live poses, hundreds a second: kept outside React, read once per drawn frame. */

import type { Pose } from "../api/types";

const KEPT = 8192;
/** Captures whose poses are kept: those that sent some last. */
const CAPTURES = 4;

export class PoseTails {
  private readonly tails = new Map<string, Pose[]>();
  /** Grows with every pose taken, so that a reader can tell whether anything is new. */
  version = 0;

  push(captureId: string | null, pose: Pose): void {
    if (captureId === null) return;
    const tail = this.tails.get(captureId) ?? [];
    this.tails.delete(captureId);
    this.tails.set(captureId, tail); // the last one is that of the newest pose
    for (const oldest of [...this.tails.keys()].slice(0, -CAPTURES)) this.tails.delete(oldest);
    tail.push(pose);
    if (tail.length > 2 * KEPT) tail.splice(0, tail.length - KEPT);
    this.version += 1;
  }

  newest(captureId: string | null): Pose | null {
    return this.tails.get(captureId ?? "")?.at(-1) ?? null;
  }

  /** The poses after `frame`, oldest first. */
  after(captureId: string | null, frame: number): readonly Pose[] {
    const tail = this.tails.get(captureId ?? "") ?? [];
    let start = tail.length;
    while (start > 0 && (tail[start - 1]?.frame ?? -1) > frame) start -= 1;
    return tail.slice(start);
  }
}

export const poses = new PoseTails();
