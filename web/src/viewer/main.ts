/** The page that `spiked export OUT viewer` writes: one scene, without a service. */

import palette from "../shared/styles/palette.css?inline";
import style from "./viewer.css?inline";

import { count } from "../shared/state/format";
import { rowAtTime } from "../features/scene/path";
import { Viewer } from "../features/scene/Viewer";
import { type Content, readContent } from "./content";

/** Duration of playback of the whole path, in seconds. */
const PLAYED_S = 10;

function element<K extends keyof HTMLElementTagNameMap>(
  kind: K,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
  ...inside: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...inside);
  return made;
}

function labelled(text: string, input: HTMLInputElement): HTMLLabelElement {
  return element("label", {}, input, text);
}

async function show(): Promise<void> {
  document.head.append(element("style", { textContent: palette + style }));
  const canvas = element("canvas", { tabIndex: 0 });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Scene: drag to turn it, scroll to come nearer, arrow keys to move");
  const bar = element("footer");
  const main = element("main", {}, element("div", { className: "stage" }, canvas), bar);
  document.body.append(main);
  const content = await readContent();
  document.title = content.name;
  const viewer = new Viewer(canvas, () => undefined);
  bar.append(...controls(viewer, content));
  await viewer.change(content.scene);
  canvas.dataset["version"] = `${viewer.version}`;
}

function controls(viewer: Viewer, { name, scene, path, sensor }: Content): HTMLElement[] {
  const last = path.times.at(-1) ?? 0;
  const first = path.times[0] ?? 0;
  const moment = element("input", { type: "range", min: `${first}`, max: `${last}`, step: "any", value: `${first}` });
  moment.setAttribute("aria-label", "Moment");
  const clock = element("output");
  const place = (time: number): void => {
    const row = rowAtTime(path, time);
    if (row < 0 || sensor === null) return;
    viewer.setPose(
      [...path.positions.subarray(3 * row, 3 * row + 3)],
      [...path.quaternions.subarray(4 * row, 4 * row + 4)],
      sensor,
    );
    moment.value = `${time}`;
    clock.textContent = `${(1000 * time).toFixed(1)} ms`;
  };
  let playing = 0;
  const play = element("button", { type: "button", textContent: "Play" });
  const stop = (): void => {
    cancelAnimationFrame(playing);
    playing = 0;
    play.textContent = "Play";
  };
  moment.addEventListener("input", () => {
    stop();
    place(moment.valueAsNumber);
  });
  play.addEventListener("click", () => {
    if (playing !== 0) {
      stop();
      return;
    }
    play.textContent = "Pause";
    let time = moment.valueAsNumber >= last ? first : moment.valueAsNumber;
    let before = performance.now();
    const step = (now: number): void => {
      time = Math.min(time + ((now - before) / 1000 / PLAYED_S) * (last - first), last);
      before = now;
      place(time);
      if (time >= last) stop();
      else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  });

  const riding = element("input", { type: "checkbox" });
  const ride = (): void => {
    viewer.setRiding(riding.checked);
    const stage = viewer.canvas.parentElement;
    stage?.classList.toggle("riding", riding.checked);
    stage?.style.setProperty("--aspect", `${(sensor?.width ?? 1) / (sensor?.height ?? 1)}`);
  };
  riding.addEventListener("change", ride);
  const drawn = element("input", { type: "checkbox", checked: true });
  const layers = (): void =>
    viewer.setLayers({
      splats: true,
      path: drawn.checked,
      frustum: drawn.checked,
      loops: false,
      grid: false,
      axes: false,
    });
  drawn.addEventListener("change", layers);
  const home = element("button", { type: "button", textContent: "Reset the view" });
  home.addEventListener("click", () => {
    riding.checked = false;
    ride();
    viewer.home();
  });

  const title = element("h1", { textContent: name });
  const about = element("p", { textContent: `${count(scene.filled.length)} splats` });
  layers();
  if (path.times.length === 0) return [title, about, home];
  viewer.setPath(path, "state");
  if (sensor === null) return [title, about, labelled("Path", drawn), home];
  place(first);
  return [title, about, play, moment, clock, labelled("Through the camera", riding), labelled("Path", drawn), home];
}

show().catch((error: unknown) => {
  const reason = error instanceof Error ? error.message : String(error);
  document.body.replaceChildren(
    element("p", { className: "fault", role: "alert", textContent: `The scene cannot be shown: ${reason}` }),
  );
});
