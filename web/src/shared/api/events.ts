/** The WebSocket for events, reopened after every loss. */

import { API } from "./http";
import type { Message, Topic } from "./types";

export type ConnectionState =
  | { state: "connecting" }
  | { state: "open" }
  /** Lost, or never there; tried again at `retryAt` (as performance.now()). */
  | { state: "waiting"; retryAt: number; attempts: number };

const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 10_000;
/** A silent connection is closed after this time: after a laptop sleeps, a dead socket still looks open. */
const SILENCE_MS = 45_000;

/** Milliseconds before attempt number `attempts`: doubled each time, between half and all of it so that pages spread out. */
export function backoff(attempts: number, random: number): number {
  const full = Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** attempts);
  return full * (0.5 + 0.5 * random);
}

export interface EventsHooks {
  onMessage: (message: Message) => void;
  onLink: (link: ConnectionState) => void;
  /** The service could not replay missed events: fetch everything again. */
  onGap: () => void;
}

export const TOPICS: readonly Topic[] = ["device", "capture", "job", "pose", "scene", "preview"];

/** Whether a slow connection lost pictures alone: newer ones follow, and nothing has to be fetched again. */
const onlyPictures = (lost: unknown): boolean => {
  const { why, by_topic: topics } = lost as { why?: string; by_topic?: Record<string, number> };
  const lostTopics = Object.keys(topics ?? {});
  return why === "slow" && lostTopics.length > 0 && lostTopics.every((topic) => topic === "preview");
};

export class Events {
  private socket: WebSocket | null = null;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private watch: ReturnType<typeof setInterval> | undefined;
  private attempts = 0;
  private heard = 0;
  private closed = false;
  /** Sequence number of the newest message, null before the first. */
  seq: number | null = null;

  constructor(
    private readonly hooks: EventsHooks,
    private readonly topics: readonly Topic[] = TOPICS,
  ) {}

  open(): void {
    this.closed = false;
    window.addEventListener("online", this.retryNow);
    document.addEventListener("visibilitychange", this.retryNow);
    this.watch = setInterval(() => {
      if (this.socket?.readyState === WebSocket.OPEN && performance.now() - this.heard > SILENCE_MS)
        this.socket.close(4000);
    }, 5000);
    this.connect();
  }

  close(): void {
    this.closed = true;
    window.removeEventListener("online", this.retryNow);
    document.removeEventListener("visibilitychange", this.retryNow);
    clearTimeout(this.timer);
    clearInterval(this.watch);
    this.socket?.close();
  }

  private readonly retryNow = (): void => {
    if (this.closed || this.socket !== null || document.hidden) return;
    clearTimeout(this.timer);
    this.connect();
  };

  private connect(): void {
    this.hooks.onLink({ state: "connecting" });
    const query = new URLSearchParams({ topics: this.topics.join(","), heartbeat: "1" });
    if (this.seq !== null) query.set("since", String(this.seq));
    const url = new URL(`${API}/events?${query.toString()}`, document.baseURI);
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(url);
    this.socket = socket;
    socket.onopen = () => {
      this.attempts = 0;
      this.heard = performance.now();
      this.hooks.onLink({ state: "open" });
    };
    socket.onmessage = (event: MessageEvent<string>) => {
      this.heard = performance.now();
      if (event.data !== "") this.take(JSON.parse(event.data) as Message); // empty: a heartbeat
    };
    socket.onclose = () => {
      this.socket = null;
      if (this.closed) return;
      const wait = backoff(this.attempts, Math.random());
      this.attempts += 1;
      this.timer = setTimeout(() => this.connect(), wait);
      this.hooks.onLink({ state: "waiting", retryAt: performance.now() + wait, attempts: this.attempts });
    };
  }

  private take(message: Message): void {
    if (message.topic === "lost") {
      if (!onlyPictures(message.data)) this.hooks.onGap();
      return;
    }
    // Sequence numbers restart with the daemon.
    if (this.seq !== null && message.seq < this.seq) this.hooks.onGap();
    this.seq = message.seq;
    this.hooks.onMessage(message);
  }
}
