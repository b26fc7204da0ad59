/** Whether a machine is too slow to draw a moving view with all pixels, by how long its pictures take. */

/** A picture is slow that comes later than this after it was asked for, ms. */
const SLOW_MS = 33;
/** So many slow pictures of a moving view, one after the other, make a machine slow; so many others make it fast again. */
const [MOST_SLOW, ENOUGH_FAST] = [3, 30];

export class Pace {
  slow: boolean;
  private requestedMs = 0;
  /** Slow pictures, one after the other; fast ones below 0. */
  private row = 0;

  /** @param always Whether the processor draws: such a machine stays slow. */
  constructor(private readonly always: boolean) {
    this.slow = always;
  }

  /** A picture is wanted from now on. */
  request(nowMs: number): void {
    this.requestedMs = nowMs;
  }

  /** It is drawn. The time since the picture before tells nothing: none is drawn that is not wanted. */
  drawn(nowMs: number, moving: boolean): void {
    if (!moving) {
      this.row = 0;
      return;
    }
    this.row = nowMs - this.requestedMs > SLOW_MS ? Math.max(this.row, 0) + 1 : Math.min(this.row, 0) - 1;
    if (this.row >= MOST_SLOW) this.slow = true;
    if (this.row <= -ENOUGH_FAST) this.slow = this.always;
  }
}
