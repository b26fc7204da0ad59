/** The colours of palette.css: readable, and apart from each other for people who lack one kind of cones. */

import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";

import { expect, it } from "vitest";

import { COMPARED_STYLES, SPEED_STYLES, STATE_STYLES, STATES } from "../../features/scene/stateStyles";

type Rgb = [number, number, number];
type Matrix = readonly [Rgb, Rgb, Rgb];

const SOURCES = join(import.meta.dirname, "..", "..");
const PALETTE = readFileSync(join(SOURCES, "shared", "styles", "palette.css"), "utf8");
const THEMES = ["light", "dark"] as const;

/** WCAG 2.2, 1.4.3 and 1.4.11. */
const TEXT = 4.5;
const GRAPHICS = 3;
/** Hundredths of OKLab's unit; 2 is about what is just noticed side by side. */
const STATES_APART = 10;
const TONES_APART = 5;
const SPEEDS_APART = 6;

/** Machado, Oliveira and Fernandes, A physiologically-based model for simulation of color vision deficiency, 2009, severity 1. */
const EYES: Record<string, Matrix> = {
  all: [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ],
  protanopia: [
    [0.152286, 1.052583, -0.204868],
    [0.114503, 0.786281, 0.099216],
    [-0.003882, -0.048116, 1.051998],
  ],
  deuteranopia: [
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.01182, 0.04294, 0.968881],
  ],
  tritanopia: [
    [1.255528, -0.076749, -0.178779],
    [-0.078411, 0.930809, 0.147602],
    [0.004733, 0.691367, 0.3039],
  ],
};

/** Linear RGB, 0 to 1, of a variable of the style sheet. */
function colourOf(name: string, theme: (typeof THEMES)[number]): Rgb {
  const value = new RegExp(`--${name}: ([^;]+);`).exec(PALETTE)?.[1] ?? "";
  const hexes = value.match(/#[0-9a-f]{6}/g) ?? [];
  const hex = hexes[theme === "dark" ? hexes.length - 1 : 0];
  if (hex === undefined) throw new Error(`palette.css has no colour ${name}`);
  return [1, 3, 5].map((at) => linear(Number.parseInt(hex.slice(at, at + 2), 16) / 255)) as Rgb;
}

const linear = (c: number): number => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
const encoded = (c: number): number => (c <= 0.0031308 ? 12.92 * c : 1.055 * c ** (1 / 2.4) - 0.055);
const times = (m: Matrix, v: Rgb): Rgb => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]) as Rgb;
const luminance = (c: Rgb): number => 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];

/** CSS' color-mix in srgb: so much of one colour, the rest of another. */
const mixed = (a: Rgb, share: number, b: Rgb): Rgb =>
  a.map((value, i) => linear(share * encoded(value) + (1 - share) * encoded(b[i] ?? 0))) as Rgb;

function contrast(a: Rgb, b: Rgb): number {
  const [dark = 0, bright = 0] = [luminance(a), luminance(b)].sort((x, y) => x - y);
  return (bright + 0.05) / (dark + 0.05);
}

/** Ottosson, A perceptual color space for image processing, 2020; of linear sRGB. */
function oklab(c: Rgb): Rgb {
  const cones = times(
    [
      [0.4122214708, 0.5363325363, 0.0514459929],
      [0.2119034982, 0.6806995451, 0.1073969566],
      [0.0883024619, 0.2817188376, 0.6299787005],
    ],
    c,
  ).map(Math.cbrt) as Rgb;
  return times(
    [
      [0.2104542553, 0.793617785, -0.0040720468],
      [1.9779984951, -2.428592205, 0.4505937099],
      [0.0259040371, 0.7827717662, -0.808675766],
    ],
    cones,
  );
}

const seen = (c: Rgb, eye: Matrix): Rgb => oklab(times(eye, c).map((x) => Math.min(Math.max(x, 0), 1)) as Rgb);

/** Every two of them, for every kind of eye, at least so far apart. */
function expectApart(names: readonly string[], theme: (typeof THEMES)[number], least: number): void {
  for (const [kind, eye] of Object.entries(EYES)) {
    const places = names.map((name) => seen(colourOf(name, theme), eye));
    for (const [i, a] of places.entries())
      for (const [k, b] of places.entries())
        if (k > i)
          expect(
            100 * Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]),
            `${names[i] ?? ""} and ${names[k] ?? ""}, ${theme}, ${kind}`,
          ).toBeGreaterThanOrEqual(least);
  }
}

it.each(THEMES)("has text with contrast enough on everything it is written on, %s", (theme) => {
  const of = (name: string): Rgb => colourOf(name, theme);
  for (const ink of ["ink", "dim", "accent", "good", "warning", "problem"])
    for (const ground of ["paper", "panel", "raised"])
      expect(contrast(of(ink), of(ground)), `${ink} on ${ground}`).toBeGreaterThanOrEqual(TEXT);
  expect(contrast(of("on-accent"), of("accent"))).toBeGreaterThanOrEqual(TEXT);
  expect(
    contrast(of("ink"), mixed(of("problem"), 0.14, of("panel"))),
    "the banner without a connection",
  ).toBeGreaterThan(TEXT);
  for (const ink of ["on-glass", "on-glass-dim"]) expect(contrast(of(ink), of("glass"))).toBeGreaterThanOrEqual(TEXT);
  const overWhite = mixed(of("glass"), 0.75, [1, 1, 1]);
  expect(contrast(of("on-glass"), overWhite), "a caption over a white picture").toBeGreaterThanOrEqual(TEXT);
  expect(contrast(of("edge"), of("paper")), "the border of a field").toBeGreaterThanOrEqual(GRAPHICS);
});

it("draws states, speeds and marks bright enough on their dark ground", () => {
  const styles = [...STATES.map((state) => STATE_STYLES[state]), ...SPEED_STYLES, ...Object.values(COMPARED_STYLES)];
  const drawn = styles.map((style) => style.colour);
  for (const name of [...drawn, "mark", "axis-x", "axis-y", "axis-z"])
    expect(contrast(colourOf(name, "dark"), colourOf("glass", "dark")), name).toBeGreaterThanOrEqual(GRAPHICS);
});

it("keeps the states apart without red, green or blue cones", () => {
  expectApart(
    STATES.map((state) => STATE_STYLES[state].colour),
    "dark",
    STATES_APART,
  );
});

it("keeps compared paths apart without red, green or blue cones", () => {
  expectApart(
    Object.values(COMPARED_STYLES).map((style) => style.colour),
    "dark",
    STATES_APART,
  );
});

it.each(THEMES)("keeps the tones and the lines of plots apart without red, green or blue cones, %s", (theme) => {
  expectApart(["good", "warning", "problem", "accent"], theme, TONES_APART);
  expectApart(["accent", "warning"], theme, STATES_APART);
});

it("makes faster brighter for everyone", () => {
  const names = SPEED_STYLES.map((style) => style.colour);
  expectApart(names, "dark", SPEEDS_APART);
  for (const [kind, eye] of Object.entries(EYES)) {
    const lightness = names.map((name) => seen(colourOf(name, "dark"), eye)[0]);
    expect(lightness, kind).toEqual([...lightness].sort((a, b) => a - b));
  }
});

it("is the one place that has colours", () => {
  const files = readdirSync(SOURCES, { recursive: true, encoding: "utf8" }).filter(
    (name) => /\.(css|tsx?)$/.test(name) && !/palette|schema\.d\.ts/.test(name),
  );
  expect(files.length).toBeGreaterThan(30);
  for (const name of files)
    expect(readFileSync(join(SOURCES, name), "utf8"), name).not.toMatch(/#[0-9a-fA-F]{3,8}\b|\brgba?\(|\bhsla?\(/);
});
