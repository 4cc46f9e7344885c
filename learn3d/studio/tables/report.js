"use strict";
const page = JSON.parse(document.getElementById("data").textContent);
const MOST_MESHES = 4;  // browsers limit the number of WebGL scenes
const config = { displayModeBar: false, responsive: true, scrollZoom: false, showTips: false };
const find = id => document.getElementById(id);
const color = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const plain = text => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");  // plotly reads text as HTML
const iou = value => value === null ? "–" : value.toFixed(3);

function element(parent, tag, values = {}) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(values)) name in made ? made[name] = value : made.setAttribute(name, value);
  return parent.appendChild(made);
}

function layout(more) {
  const axis = { gridcolor: color("--line"), zerolinecolor: color("--line"), automargin: true };
  return { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: color("--text"), family: "system-ui, sans-serif" },
    margin: { l: 44, r: 10, t: 10, b: 36 }, showlegend: false, hoverlabel: { namelength: -1 }, xaxis: axis, yaxis: axis, ...more(axis) };
}

// Curves and the polar plot.

function drawCurves() {
  const place = find("curves");
  page.curves.forEach((panel, number) => {
    if (!place.children[number]) {
      const block = element(place, "div");
      element(block, "h3", { textContent: panel.title });
      element(block, "div", { className: "plot", role: "img", "aria-label": `${panel.title}, over the training steps` });
    }
    const traces = page.runs.flatMap((run, k) => panel.steps[k] === null ? [] : [{ x: panel.steps[k], y: panel.values[k], name: plain(run.name),
      mode: panel.steps[k].length > 30 ? "lines" : "lines+markers", line: { color: run.color, width: 2 }, marker: { size: 5 } }]);
    Plotly.react(place.children[number].lastChild, traces, layout(axis => ({ hovermode: "x unified", xaxis: { ...axis, rangemode: "tozero" },
      hoverlabel: { namelength: -1, bgcolor: color("--page") }, yaxis: { ...axis, type: panel.log ? "log" : "linear", nticks: 6 } })), config);
  });
}

function drawViews() {
  const traces = page.views.map(({ azimuths, ious }, k) => ({ type: "scatterpolar", mode: "lines+markers", name: plain(page.runs[k].name), theta: [...azimuths, azimuths[0]],
    r: [...ious, ious[0]], line: { color: page.runs[k].color, width: 2 }, hovertemplate: "%{theta}°: %{r:.3f}" }));
  const top = Math.max(0.1, ...page.views.flatMap(view => view.ious));
  const lines = { gridcolor: color("--line"), linecolor: color("--line") };
  Plotly.react("views", traces, layout(() => ({ margin: { l: 40, r: 40, t: 30, b: 30 }, polar: { bgcolor: "rgba(0,0,0,0)",
    angularaxis: { ...lines, rotation: 270, dtick: 45 }, radialaxis: { ...lines, range: [0, Math.min(1, 1.05 * top)], angle: 290, nticks: 5 } } })), config);
}

// Shapes: a scene for each mesh, used again for the next image. All scenes share one camera.

let item = 0, camera = null, active = null, panes = [];

function makePanes(chosen) {
  for (const pane of panes) { Plotly.purge(pane.scene); pane.figure.remove(); }
  const meshes = page.items[0].meshes.length > page.runs.length ? [...chosen, page.runs.length] : chosen;
  panes = meshes.map(mesh => {
    const figure = element(find("panes"), "figure");
    const scene = element(figure, "div", { className: "mesh", tabIndex: 0, role: "application" });
    scene.addEventListener("pointerdown", () => active = scene, true);
    scene.addEventListener("keydown", turnByKey);
    return { mesh, figure, scene, title: element(figure, "figcaption") };
  });
}

function drawPanes() {
  const shown = page.items[item], reach = shown.reach;
  const axis = { visible: false, range: [-reach, reach], autorange: false };
  for (const { mesh, scene, title } of panes) {
    const { empty, ...mesh3d } = shown.meshes[mesh], run = page.runs[mesh];
    const name = run ? run.name : "true shape";
    const score = run ? `, ${page.kind} ${iou(shown.ious[mesh])}` : "";
    title.replaceChildren();
    if (run) element(title, "i").style.background = run.color;
    title.append(name + score + (empty ? " (empty)" : ""));
    if (!empty) element(title, "button", { type: "button", textContent: "save OBJ", onclick: () => save(mesh3d, `${shown.name} ${name}.obj`) });
    scene.setAttribute("aria-label", `${name}${score}: 3D shape; arrow keys turn it, plus and minus bring it nearer`);
    const trace = { type: "mesh3d", ...mesh3d, color: color("--clay"), hoverinfo: "skip",
      lighting: { ambient: 0.35, diffuse: 0.7, specular: 0.05, roughness: 0.8, fresnel: 0.05 }, lightposition: { x: -1e5, y: 1e5, z: 5e4 } };
    Plotly.react(scene, empty ? [] : [trace], layout(() => ({ margin: { l: 0, r: 0, t: 0, b: 0 },
      scene: { xaxis: axis, yaxis: axis, zaxis: axis, aspectmode: "cube", dragmode: "turntable", camera } })), config);
    if (!scene.ready) {
      scene.ready = true;
      for (const event of ["plotly_relayouting", "plotly_relayout"]) scene.on(event, moved => follow(scene, moved["scene.camera"]));
    }
  }
}

function save(mesh, name) {
  const arrays = "xyzijk".split("").map(key => {
    const { dtype, bdata } = mesh[key], type = { i2: Int16Array, u2: Uint16Array, u4: Uint32Array }[dtype];
    return new type(Uint8Array.from(atob(bdata), byte => byte.charCodeAt()).buffer);
  });
  const lines = (letter, [a, b, c], text) => Array.from(a, (first, k) => `${letter} ${text(first)} ${text(b[k])} ${text(c[k])}`);
  const [x, y, z, i, j, k] = arrays;  // z is up in the page, y in the file
  const points = lines("v", [x, z, y.map(value => -value)], value => (value * page.unit).toFixed(4));
  const address = URL.createObjectURL(new Blob([[...points, ...lines("f", [i, j, k], value => value + 1), ""].join("\n")]));
  Object.assign(document.createElement("a"), { href: address, download: name.replace(/[^\w.-]+/g, "-") }).click();
  URL.revokeObjectURL(address);
}

function follow(scene, moved) {
  if (scene !== active || !moved) return;
  camera = moved;
  for (const other of panes) if (other.scene !== scene) Plotly.relayout(other.scene, { "scene.camera": camera });
}

function turnByKey(event) {
  const turns = { ArrowLeft: [-10, 0, 1], ArrowRight: [10, 0, 1], ArrowUp: [0, 10, 1], ArrowDown: [0, -10, 1], "+": [0, 0, 0.9], "-": [0, 0, 1 / 0.9] };
  if (!(event.key in turns) || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  const [across, up, scale] = turns[event.key], { x, y, z } = camera.eye, far = Math.hypot(x, y, z);
  const azimuth = Math.atan2(y, x) + across * Math.PI / 180;
  const height = Math.max(-1.5, Math.min(1.5, Math.asin(z / far) + up * Math.PI / 180)), away = far * scale;
  lookFrom([Math.cos(azimuth) * Math.cos(height), Math.sin(azimuth) * Math.cos(height), Math.sin(height)].map(value => value * away));
  active = null;
  for (const pane of panes) Plotly.relayout(pane.scene, { "scene.camera": camera });
}

function lookFrom([x, y, z]) {
  camera = { eye: { x, y, z }, center: { x: 0, y: 0, z: 0 }, up: { x: 0, y: 0, z: 1 } };
}

function show(number) {
  item = number;
  active = null;
  const { name, view, index, image, eye } = page.items[item];
  lookFrom(eye.map(value => 1.35 * value));
  find("chosen").textContent = `${name}, view ${view} (image ${index})`;
  Object.assign(find("picture"), { src: image, alt: `Input image: ${name}, view ${view}` });
  find("items").querySelectorAll("input")[item].checked = true;
  for (const row of find("objects").tBodies[0].rows) row.classList.toggle("chosen", Number(row.dataset.item ?? -1) === item);
  drawPanes();
}

// Choosing images, objects of the table, and runs if there are more runs than scenes.

find("items").addEventListener("change", event => show(Number(event.target.value)));
find("objects").tBodies[0].addEventListener("click", event => {
  const row = event.target.closest("tr[data-item]");
  if (!row) return;
  show(Number(row.dataset.item));
  find("shapes-title").scrollIntoView({ behavior: "smooth" });
});
find("objects").tHead.addEventListener("click", event => {
  const head = event.target.closest("th");
  if (!head) return;
  const body = find("objects").tBodies[0], column = head.cellIndex, down = head.getAttribute("aria-sort") === "descending" || (column === 0 && !head.ariaSort);
  const value = row => column ? parseFloat(row.cells[column].textContent) : row.cells[0].textContent;
  const order = (a, b) => column ? (isNaN(a) ? -1 : a) - (isNaN(b) ? -1 : b) : a.localeCompare(b, undefined, { numeric: true });
  for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down ? "ascending" : "descending");
  body.append(...[...body.rows].sort((a, b) => (down ? 1 : -1) * order(value(a), value(b))));
});
find("all")?.addEventListener("change", event => find("objects").classList.toggle("some", !event.target.checked));
const boxes = [...find("choice").querySelectorAll("input")];
function chooseRuns() {
  const chosen = boxes.filter(box => box.checked);
  for (const box of boxes) box.disabled = box.checked ? chosen.length === 1 : chosen.length === MOST_MESHES;
  makePanes(chosen.map(box => Number(box.value)));
}
boxes.forEach((box, number) => box.checked = number < MOST_MESHES);
find("choice").hidden = boxes.length <= MOST_MESHES;
find("choice").addEventListener("change", () => { chooseRuns(); drawPanes(); });

function drawPlots() {
  if (page.curves.length) drawCurves();
  if (page.views.length) drawViews();
}
chooseRuns();
show(0);
drawPlots();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawPanes(); drawPlots(); });
