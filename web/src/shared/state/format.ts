/** Numbers and times as the page writes them: always with a unit, never wider than they need to be. */

const NUMBER = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const SPACE = "\u202f"; // narrow no-break space between number and unit

export const count = (n: number): string => NUMBER.format(n).replaceAll(",", SPACE);

const scaled = (value: number, base: number, units: readonly string[]): string => {
  let size = value;
  let unit = 0;
  while (Math.abs(size) >= base && unit < units.length - 1) {
    size /= base;
    unit += 1;
  }
  const digits = unit === 0 ? 0 : Math.abs(size) >= 100 ? 0 : Math.abs(size) >= 10 ? 1 : 2;
  return `${size.toFixed(digits)}${SPACE}${units[unit] ?? ""}`;
};

export const bytes = (n: number): string => scaled(n, 1000, ["B", "kB", "MB", "GB", "TB"]);
export const rate = (hz: number): string => scaled(hz, 1000, ["Hz", "kHz", "MHz"]);
export const compact = (n: number): string => (n < 10_000 ? count(n) : scaled(n, 1000, ["", "k", "M", "G"]).trim());

/** A duration: 64.0 ms, 3.20 s, 2 min 05 s, 3 h 12 min. */
export function duration(s: number): string {
  if (s < 0.9995) return `${(s * 1000).toFixed(s < 0.1 ? 1 : 0)}${SPACE}ms`;
  if (s < 60) return `${s.toFixed(s < 10 ? 2 : 1)}${SPACE}s`;
  const minutes = Math.floor(s / 60);
  if (minutes < 60)
    return `${minutes}${SPACE}min ${Math.floor(s % 60)
      .toString()
      .padStart(2, "0")}${SPACE}s`;
  return `${Math.floor(minutes / 60)}${SPACE}h ${(minutes % 60).toString().padStart(2, "0")}${SPACE}min`;
}

export const percent = (share: number): string => `${(100 * share).toFixed(share < 0.1 ? 1 : 0)}${SPACE}%`;
export const decibel = (db: number | null | undefined): string => (db == null ? "–" : `${db.toFixed(1)}${SPACE}dB`);
export const small = (x: number | null | undefined): string =>
  x == null
    ? "–"
    : x === 0 || (Math.abs(x) >= 0.01 && Math.abs(x) < 1000)
      ? x.toPrecision(3)
      : x.toExponential(1).replace("e-", "e−");

const CLOCK = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });
const DAY = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", year: "numeric" });

/** Local time of day, with the day before it when it is another. */
export function when(iso: string, now: Date = new Date()): string {
  const at = new Date(iso);
  const clock = CLOCK.format(at);
  return at.toDateString() === now.toDateString() ? clock : `${DAY.format(at)}, ${clock}`;
}
