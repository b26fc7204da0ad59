import { afterEach, beforeEach, expect, it, vi } from "vitest";

import { backoff, Events, type ConnectionState } from "./events";

class Socket {
  static made: Socket[] = [];
  static readonly OPEN = 1;
  readyState = 0;
  onopen: (() => void) | null = null;
  onclose: (() => void) | null = null;
  onmessage: ((event: { data: string }) => void) | null = null;
  constructor(readonly url: URL) {
    Socket.made.push(this);
  }
  close(): void {
    this.onclose?.();
  }
  say(message: object): void {
    this.onmessage?.({ data: JSON.stringify(message) });
  }
}
const newest = (): Socket => {
  const socket = Socket.made.at(-1);
  if (socket === undefined) throw new Error("no socket was opened");
  return socket;
};

let links: ConnectionState[];
let seen: number[];
let gaps: number;
let events: Events;

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal("WebSocket", Socket);
  Socket.made = [];
  links = [];
  seen = [];
  gaps = 0;
  events = new Events({
    onLink: (link) => links.push(link),
    onMessage: (message) => seen.push(message.seq),
    onGap: () => (gaps += 1),
  });
  events.open();
});
afterEach(() => {
  events.close();
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

it("waits longer after each failure, up to ten seconds", () => {
  expect([0, 1, 2, 20].map((n) => backoff(n, 1))).toEqual([250, 500, 1000, 10_000]);
  expect(backoff(20, 0)).toBe(5000);
});

it("stays connected in silence as long as heartbeats come", () => {
  expect(String(newest().url)).toContain("heartbeat=1");
  newest().readyState = Socket.OPEN;
  newest().onopen?.();
  for (let beat = 0; beat < 12; beat += 1) {
    vi.advanceTimersByTime(15_000);
    newest().onmessage?.({ data: "" });
  }
  expect(Socket.made.length).toBe(1);
  expect([seen, gaps]).toEqual([[], 0]);
});

it("fetches nothing again for pictures that a slow connection has lost", () => {
  newest().onopen?.();
  newest().say({ seq: 5, topic: "lost", data: { why: "slow", by_topic: { preview: 3 } } });
  expect(gaps).toBe(0);
  newest().say({ seq: 6, topic: "lost", data: { why: "slow", by_topic: { preview: 3, capture: 1 } } });
  newest().say({ seq: 7, topic: "lost", data: { why: "restart", by_topic: {} } });
  expect(gaps).toBe(2);
});

it("comes back and asks for what it has missed", () => {
  newest().onopen?.();
  newest().say({ seq: 41, topic: "pose" });
  newest().close();
  expect(links.at(-1)?.state).toBe("waiting");
  vi.advanceTimersByTime(300);
  expect(Socket.made).toHaveLength(2);
  expect(newest().url.searchParams.get("since")).toBe("41");
  newest().onopen?.();
  newest().say({ seq: 42, topic: "pose" });
  expect(seen).toEqual([41, 42]);
  expect(gaps).toBe(0);
});

it("asks for everything anew when messages are lost or the service has begun to count again", () => {
  newest().onopen?.();
  newest().say({ seq: 100, topic: "job" });
  newest().say({ seq: 101, topic: "lost", data: {} });
  expect(gaps).toBe(1);
  newest().say({ seq: 3, topic: "job" });
  expect(gaps).toBe(2);
  expect(seen).toEqual([100, 3]);
});

it("stays closed when it is closed", () => {
  events.close();
  vi.advanceTimersByTime(60_000);
  expect(Socket.made).toHaveLength(1);
});
