"use strict";

const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);

/** Points [x, y] as a line that fills an SVG of 400 x 250; `square` keeps the scale of both axes equal. */
function draw(svg, points, square) {
  svg.replaceChildren();
  if (points.length < 2) return;
  const range = (k) => [Math.min(...points.map((p) => p[k])), Math.max(...points.map((p) => p[k]))];
  const [[x0, x1], [y0, y1]] = [range(0), range(1)];
  let sx = 360 / (x1 - x0 || 1e-9);
  let sy = 200 / (y1 - y0 || 1e-9);
  if (square) sx = sy = Math.min(sx, sy);
  const at = points.map(([x, y]) => [20 + (x - x0) * sx, 225 - (y - y0) * sy]);
  const line = document.createElementNS(SVG, "polyline");
  line.setAttribute("points", at.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "));
  const end = document.createElementNS(SVG, "circle");
  end.setAttribute("cx", at.at(-1)[0].toFixed(1));
  end.setAttribute("cy", at.at(-1)[1].toFixed(1));
  end.setAttribute("r", "4");
  svg.append(line, end);
}

let picture = 0;

function show(state) {
  byId("title").textContent = state.title;
  document.title = `${state.stage} · ${state.title}`;
  if (state.frames === undefined) return;
  const why = state.reason ? ` (${state.reason})` : "";
  byId("line").textContent =
    `${state.stage} · ${state.state}${why} · ${state.frames} frames · ${state.poses} poses · ` +
    `${state.splats} splats · ${state.seconds.toFixed(1)} s`;
  byId("progress").value = state.stage === "done" ? 1 : state.progress;
  draw(byId("path"), state.path.map(([x, , z]) => [x, z]), true);
  draw(byId("curve"), state.curve, false);
  if (state.curve.length) byId("curve-caption").textContent = `PSNR of the views, now ${state.curve.at(-1)[1].toFixed(1)} dB`;
  if (state.picture !== picture) {
    picture = state.picture;
    for (const name of ["observed", "rendered", "difference"]) {
      byId(name).src = `${name}.png?${picture}`;
      byId(name).hidden = false;
    }
  }
}

async function follow() {
  try {
    show(await (await fetch("state.json", { cache: "no-store" })).json());
  } catch {
    byId("line").textContent = "the reconstruction has ended; this is its last state";
    setTimeout(follow, 5000);
    return;
  }
  setTimeout(follow, 700);
}

follow();
