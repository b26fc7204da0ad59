"use strict";

const API = "api/v1";
const POLL_MS = 500;
const at = (id) => document.getElementById(id);
const shown = { capture: null, version: 0 };

async function ask(path, options) {
  const response = await fetch(`${API}/${path}`, options);
  if (response.ok) return response;
  const problem = await response.json();
  throw new Error(problem.detail);
}

const post = (path, body) =>
  ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

function showPicture(image, blob) {
  const before = image.src;
  image.src = URL.createObjectURL(blob);
  image.hidden = false;
  if (before) URL.revokeObjectURL(before);
}

const count = (n) => n.toLocaleString("en");

function figuresOf(capture) {
  const { sensor, counters, reconstruction: r } = capture;
  const rows = [["source", capture.source]];
  if (sensor) rows.push(["camera", `${sensor.width} × ${sensor.height}, ${count(sensor.frame_rate_hz)} Hz`]);
  if (counters) {
    rows.push(["device", counters.device], ["received", `${count(counters.received)} frames`]);
    const lost = Object.entries(counters.lost).filter(([, n]) => n > 0);
    rows.push(["lost", lost.length ? lost.map(([cause, n]) => `${count(n)} ${cause}`).join(", ") : "none"]);
    for (const c of counters.consumers) {
      const missed = c.policy === "latest" ? "skipped" : "lost";
      rows.push([`→ ${c.name}`, `${count(c.lag_frames)} behind, ${count(c.lost)} ${missed}${c.lagging ? ", lagging" : ""}`]);
    }
  }
  if (r) {
    rows.push(["reconstruction", `${r.stage}, ${r.state}${r.reason ? ` (${r.reason})` : ""}`]);
    rows.push(["poses", `${count(r.poses)} for ${count(r.frames)} frames`], ["splats", count(r.splats)]);
    if (r.loss !== null) rows.push(["loss", r.loss.toExponential(2)]);
    rows.push(["version", r.version]);
  }
  for (const warning of capture.warnings) rows.push(["warning", warning]);
  return rows;
}

function showFigures(capture) {
  at("figures").replaceChildren(
    ...figuresOf(capture).flatMap(([name, value]) => {
      const term = document.createElement("dt");
      const description = document.createElement("dd");
      term.textContent = name;
      description.textContent = value;
      return [term, description];
    }),
  );
  at("state").textContent = capture.state;
  at("state").dataset.state = capture.state;
  at("reason").textContent = capture.reason;
  const refining = capture.state === "finishing" && capture.reconstruction;
  at("refined").hidden = !refining;
  if (refining) at("refined").value = capture.reconstruction.progress;
  at("stop").disabled = capture.state === "complete" || capture.state === "failed";
}

/** Path from above: x to the right, z up, with the viewing direction at the newest pose. */
function drawPath(canvas, trajectory) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const points = trajectory.positions.map(([x, , z]) => [x, z]);
  const range = (k) => [Math.min(...points.map((p) => p[k])), Math.max(...points.map((p) => p[k]))];
  const [[x0, x1], [z0, z1]] = [range(0), range(1)];
  const scale = 0.8 * Math.min(canvas.width / Math.max(x1 - x0, 1e-9), canvas.height / Math.max(z1 - z0, 1e-9));
  const place = ([x, z]) => [
    canvas.width / 2 + scale * (x - (x0 + x1) / 2),
    canvas.height / 2 - scale * (z - (z0 + z1) / 2),
  ];
  const pen = canvas.getContext("2d");
  pen.lineWidth = 2 * ratio;
  pen.lineJoin = "round";
  for (let i = 1; i < points.length; i += 1) {
    pen.strokeStyle = `hsl(${260 - (200 * i) / points.length} 65% 50%)`;
    pen.beginPath();
    pen.moveTo(...place(points[i - 1]));
    pen.lineTo(...place(points[i]));
    pen.stroke();
  }
  const [w, x, y, z] = trajectory.quaternions_wxyz.at(-1);
  const [right, up] = place(points.at(-1));
  const forward = [2 * (x * z + w * y), 1 - 2 * (x * x + y * y)];
  const length = (22 * ratio) / Math.hypot(...forward);
  pen.strokeStyle = pen.fillStyle = "#d1495b";
  pen.beginPath();
  pen.arc(right, up, 5 * ratio, 0, 7);
  pen.fill();
  pen.beginPath();
  pen.moveTo(right, up);
  pen.lineTo(right + length * forward[0], up - length * forward[1]);
  pen.stroke();
}

/** At most this many poses are drawn; more than a canvas has pixels would show nothing more. */
function thin(trajectory, most = 600) {
  const last = trajectory.positions.length - 1;
  const rows = last < most ? [...trajectory.positions.keys()] : Array.from({ length: most }, (_, i) => Math.round((i * last) / (most - 1)));
  return {
    positions: rows.map((i) => trajectory.positions[i]),
    quaternions_wxyz: rows.map((i) => trajectory.quaternions_wxyz[i]),
  };
}

async function showVersion(id, version) {
  const trajectory = await (await ask(`captures/${id}/trajectory`)).json();
  drawPath(at("path"), thin(trajectory));
  const pose = { position: trajectory.positions.at(-1), quaternion_wxyz: trajectory.quaternions_wxyz.at(-1) };
  const picture = await post(`captures/${id}/views`, pose);
  showPicture(at("view"), await picture.blob());
  at("view-note").textContent = `rendered from the newest pose, version ${version}`;
  at("ply").href = `${API}/captures/${id}/scene?format=ply`;
  at("tum").href = `${API}/captures/${id}/trajectory?format=tum`;
  at("downloads").hidden = false;
}

async function refresh() {
  const captures = await (await ask("captures")).json();
  const capture = captures.at(-1);
  if (!capture) {
    at("state").textContent = "idle";
    at("stop").disabled = true;
    return;
  }
  if (capture.id !== shown.capture) {
    shown.capture = capture.id;
    shown.version = 0;
    at("downloads").hidden = at("view").hidden = at("preview").hidden = true;
  }
  showFigures(capture);
  if (capture.state === "streaming" || at("preview").hidden) {
    const response = await fetch(`${API}/captures/${capture.id}/preview`);
    if (response.ok) showPicture(at("preview"), await response.blob());
  }
  const version = capture.reconstruction?.version ?? 0;
  if (version !== shown.version) {
    shown.version = version;
    await showVersion(capture.id, version);
  }
}

async function keepRefreshing() {
  try {
    await refresh();
    at("told").textContent = "";
  } catch (error) {
    at("told").textContent = error instanceof TypeError ? "the service does not answer" : error.message;
  }
  window.setTimeout(keepRefreshing, POLL_MS);
}

at("start").addEventListener("submit", async (event) => {
  event.preventDefault();
  const frames = at("frames").valueAsNumber;
  try {
    await post("captures", { source: at("source").value, ...(Number.isNaN(frames) ? {} : { frames }) });
  } catch (error) {
    window.alert(error.message);
  }
});

at("stop").addEventListener("click", () => ask(`captures/${shown.capture}:stop`, { method: "POST" }));

ask("devices").then(async (response) => {
  for (const device of await response.json()) {
    const option = document.createElement("option");
    option.value = device.source;
    option.label = device.description;
    at("devices").append(option);
  }
});
keepRefreshing();
