/** Live poses, hundreds a second: kept outside React, read once per drawn frame. */

import type { Pose } from "../api/types";

const KEPT = 8192;

export class PoseTail {
  private captureId: string | null = null;
  private tail: Pose[] = [];
  /** Grows with every pose taken, so that a reader can tell whether anything is new. */
  version = 0;

  push(captureId: string | null, pose: Pose): void {
    if (captureId !== this.captureId) {
      this.captureId = captureId;
      this.tail = [];
    }
    this.tail.push(pose);
    if (this.tail.length > 2 * KEPT) this.tail.splice(0, this.tail.length - KEPT);
    this.version += 1;
  }

  newest(captureId: string | null): Pose | null {
    return captureId === this.captureId ? (this.tail.at(-1) ?? null) : null;
  }

  /** The poses after `frame`, oldest first. */
  after(captureId: string | null, frame: number): readonly Pose[] {
    if (captureId !== this.captureId) return [];
    let start = this.tail.length;
    while (start > 0 && (this.tail[start - 1]?.frame ?? -1) > frame) start -= 1;
    return this.tail.slice(start);
  }
}

export const poses = new PoseTail();
