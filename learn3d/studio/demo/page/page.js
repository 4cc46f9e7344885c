// The page: takes pictures, shows their outlines for correction, and shows the meshes that the server makes.
"use strict";

const $ = (id) => document.getElementById(id);
const picture = $("picture");
const WORDS = {
  camera: "Finding the camera …", shape: "Finding the shape …", stretch: "Stretching the shape …",
  surface: "Bending the shape to the outline …", colours: "Adding the colours …",
};
const HINT = "Outline wrong? Correct it on the picture:";
const HINTS = {
  box: "Drag a box around the object.",
  add: "Paint over the missing part.",
  remove: "Paint over the part that does not belong to it.",
};
const OBJECT = 1, BACKGROUND = 2, OPEN = 3; // the values of learn3d.studio.picture_to_mesh.cutting
const BRUSH = 12, REACH = 34; // radii in pixels: of a stroke, and of the region around it in which the outline may move
let side = 512, most = 8, name = "picture", colors = null, given = null, mask = null, tool = null, drag = null, current = null;
let album = [], chosen = 0; // several pictures of one object; `colors`, `given` and `mask` are those of album[chosen]

// Taking pictures

/** Read a picture with sides of at most `side` pixels: { name, colors, given }. */
async function load(source, title, side) {
  const image = new Image();
  image.src = typeof source === "string" ? source : URL.createObjectURL(source);
  await image.decode();
  if (typeof source !== "string") URL.revokeObjectURL(image.src);
  const scale = side / Math.max(image.naturalWidth, image.naturalHeight);
  if (!(scale > 0 && scale < Infinity)) throw new Error("it has no size");
  const width = Math.max(1, Math.round(image.naturalWidth * scale)), height = Math.max(1, Math.round(image.naturalHeight * scale));
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, width, height);
  const alpha = context.getImageData(0, 0, width, height).data.filter((_, i) => i % 4 === 3);
  context.globalCompositeOperation = "destination-over"; // white below transparent pictures
  context.fillStyle = "#fff";
  context.fillRect(0, 0, width, height);
  return {
    name: title.replace(/\.[^.]*$/, "").replace(/[^\p{L}\p{N} _-]/gu, "") || "picture",
    colors: context.getImageData(0, 0, width, height),
    given: alpha.some((value) => value < 250) ? alpha : new Uint8ClampedArray(alpha.length).fill(255),
    mask: null,
  };
}

/** Take one picture, or several of the same object: [[source, title], ...]. */
async function take(sources) {
  if (sources.length > most) return say(`At most ${most} pictures of an object; ${sources.length} came.`, true);
  const fitting = Math.floor(side * Math.sqrt(5 / (4 * sources.length + 1))); // all fit into one request
  try {
    album = await Promise.all(sources.map(([source, title]) => load(source, title, Math.min(side, fitting))));
  } catch {
    current?.abort();
    return say("This file is not a picture that your browser can open. Try a PNG or JPEG.", true);
  }
  document.body.classList.add("given");
  $("invitation").hidden = true;
  $("stage").hidden = $("tools").hidden = false;
  $("choose").textContent = "Other pictures";
  $("choose").classList.remove("primary");
  for (const button of $("examples").children) button.setAttribute("aria-pressed", String(button.firstChild.src === sources[0][0]));
  scrollTo(0, 0); // on a phone the examples are below
  turnTo(0);
  sendAll();
}

/** Show one of the pictures for correction. */
function turnTo(number) {
  chosen = number;
  ({ name, colors, given, mask } = album[chosen]);
  Object.assign(picture, { width: colors.width, height: colors.height });
  choose(null);
  show();
}

/** Small pictures of the album with their outlines; one that was left out is crossed. */
function showAlbum() {
  $("album").hidden = album.length < 2;
  $("album").replaceChildren(...(album.length < 2 ? [] : album.map((each, number) => {
    const button = document.createElement("button"), { width, height } = each.colors;
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    canvas.getContext("2d").putImageData(each.colors, 0, 0);
    if (each.mask) canvas.getContext("2d").drawImage(outline(each.mask, width, height), 0, 0);
    button.title = each.unused ? `Left out: ${each.unused}` : `Picture ${number + 1}`;
    button.setAttribute("aria-label", button.title);
    button.setAttribute("aria-pressed", String(number === chosen));
    button.classList.toggle("unused", Boolean(each.unused));
    button.append(canvas);
    button.onclick = () => turnTo(number);
    return button;
  })));
  $("without").hidden = album.length < 2;
}

$("without").onclick = () => {
  album.splice(chosen, 1);
  turnTo(Math.max(0, chosen - 1));
  sendAll();
};

function takeFiles(files) {
  if (files.length) take([...files].map((file) => [file, file.name]));
  else say("Drop a picture file. A picture in another page must be saved first.", true);
}

for (const [button, input] of [["choose", "file"], ["photograph", "camera"]]) {
  $(button).onclick = () => $(input).click();
  $(input).onchange = () => { if ($(input).files.length) takeFiles($(input).files); $(input).value = ""; };
}
addEventListener("paste", (event) => { if (event.clipboardData.files.length) takeFiles(event.clipboardData.files); });
addEventListener("dragover", (event) => { event.preventDefault(); $("over").hidden = false; });
addEventListener("dragleave", (event) => { if (!event.relatedTarget) $("over").hidden = true; });
addEventListener("drop", (event) => { event.preventDefault(); $("over").hidden = true; takeFiles(event.dataTransfer.files); });

// The picture, its outline, and its correction

function show() {
  const context = picture.getContext("2d"), { width, height } = colors;
  context.putImageData(colors, 0, 0);
  if (mask) context.drawImage(outline(mask, width, height), 0, 0);
  if (!drag) return showAlbum();
  if (tool === "box") {
    context.setLineDash([8, 6]);
    for (const [color, shift] of [["#000", 0], ["#fff", 7]]) {
      Object.assign(context, { strokeStyle: color, lineWidth: 2, lineDashOffset: shift });
      context.strokeRect(...boxOf(drag));
    }
    context.setLineDash([]);
  } else {
    Object.assign(context, { strokeStyle: tool === "add" ? "#19b35acc" : "#e0364ccc", lineWidth: 2 * BRUSH, lineCap: "round", lineJoin: "round" });
    context.beginPath();
    for (const [x, y] of [drag[0], ...drag]) context.lineTo(x, y);
    context.stroke();
  }
}

/** The outline: white inside of the mask's border, dark outside, so that any picture shows it. */
function outline(mask, width, height) {
  const image = new ImageData(width, height), thick = 2;
  const near = (x, y, value) => {
    for (let v = Math.max(0, y - thick); v <= Math.min(height - 1, y + thick); v++)
      for (let u = Math.max(0, x - thick); u <= Math.min(width - 1, x + thick); u++)
        if (mask[v * width + u] > 127 === value) return true;
    return false;
  };
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      const i = y * width + x, inside = mask[i] > 127;
      if (near(x, y, !inside)) image.data.set(inside ? [255, 255, 255, 255] : [20, 24, 32, 190], 4 * i);
    }
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

function at(event) {
  const place = picture.getBoundingClientRect(), part = (value, most) => Math.min(most, Math.max(0, value * most));
  return [part((event.clientX - place.left) / place.width, picture.width), part((event.clientY - place.top) / place.height, picture.height)];
}

function boxOf(points) {
  const [[x, y], [u, v]] = [points[0], points[points.length - 1]];
  return [Math.min(x, u), Math.min(y, v), Math.abs(x - u), Math.abs(y - v)].map(Math.round);
}

/** The label of each pixel after a stroke, see learn3d.studio.picture_to_mesh.cutting. */
function strokesOf(points, value) {
  const { width, height } = colors, strokes = new Uint8Array(width * height);
  const stamp = (x, y, radius, what) => {
    for (let v = Math.max(0, Math.ceil(y - radius)); v <= Math.min(height - 1, y + radius); v++)
      for (let u = Math.max(0, Math.ceil(x - radius)); u <= Math.min(width - 1, x + radius); u++)
        if ((u - x) ** 2 + (v - y) ** 2 <= radius ** 2) strokes[v * width + u] = what;
  };
  for (const [radius, what] of [[REACH, OPEN], [BRUSH, value]])
    points.forEach(([x, y], k) => {
      const [u, v] = points[Math.max(0, k - 1)], steps = Math.ceil(Math.hypot(x - u, y - v) / 4) || 1;
      for (let s = 1; s <= steps; s++) stamp(u + (x - u) * s / steps, v + (y - v) * s / steps, radius, what);
    });
  return strokes;
}

function choose(which) {
  tool = which;
  picture.classList.toggle("tool", Boolean(tool));
  $("hint").textContent = HINTS[tool] || HINT;
  for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
}

for (const button of document.querySelectorAll("[data-tool]"))
  button.onclick = () => choose(tool === button.dataset.tool ? null : button.dataset.tool);
$("again").onclick = () => { mask = album[chosen].mask = null; album.length > 1 ? sendAll() : send(given); };
picture.onpointerdown = (event) => {
  if (!tool) return;
  picture.setPointerCapture(event.pointerId);
  drag = [at(event)];
  show();
};
picture.onpointermove = (event) => { if (drag) { drag.push(at(event)); show(); } };
picture.onpointercancel = () => { drag = null; show(); };
picture.onpointerup = () => {
  if (!drag) return;
  const points = drag, box = boxOf(points), empty = new Uint8ClampedArray(given.length);
  drag = null;
  show();
  if (tool === "box" && Math.min(box[2], box[3]) > 8) send(given, null, box);
  if (tool === "add") send(mask || empty, strokesOf(points, OBJECT));
  if (tool === "remove") send(mask || empty, strokesOf(points, BACKGROUND));
};

// The server's work

function say(text, wrong = false) {
  $("words").textContent = text;
  const empty = document.querySelector(".view.empty p");
  if (empty && !wrong) empty.textContent = text;
  $("status").classList.toggle("error", wrong);
  if (!wrong) return;
  busy(false);
  $("warning").hidden = true;
  $("status").scrollIntoView({ block: "nearest" });
}

function busy(part) {
  document.body.classList.toggle("busy", part !== false);
  $("progress").hidden = part === false;
  if (typeof part === "number") $("progress").value = part;
}

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

/** Send the picture on the stage with a mask or hints about it. */
function send(alpha, strokes = null, box = null) {
  const { width, height, data } = colors, pixels = width * height;
  const body = new Uint8Array(pixels * (strokes ? 5 : 4));
  body.set(withAlpha(data, alpha));
  if (strokes) body.set(strokes, 4 * pixels);
  post(`width=${width}&height=${height}${box ? `&box=${box}` : ""}`, body);
}

/** Send all pictures, with the masks that are known. */
function sendAll() {
  if (album.length < 2) return send(mask || given);
  const sizes = (side) => album.map((each) => each.colors[side]).join();
  const parts = album.map((each) => withAlpha(each.colors.data, each.mask || each.given));
  for (const each of album) each.unused = null;
  post(`width=${sizes("width")}&height=${sizes("height")}`, new Blob(parts));
}

function withAlpha(data, alpha) {
  const body = new Uint8Array(data);
  for (let i = 0; i < alpha.length; i++) body[4 * i + 3] = alpha[i];
  return body;
}

async function post(query, body) {
  current?.abort();
  const mine = (current = new AbortController()), category = $("category").value;
  $("warning").hidden = $("downloads").hidden = true;
  say("Finding the object …");
  busy(0.05);
  try {
    const request = { method: "POST", body, signal: mine.signal, headers: { "Content-Type": "application/octet-stream" } };
    let answer, address = `mesh?${query}${category && `&category=${category}`}`;
    while ((answer = await fetch(address, request)).status === 503 && !mine.signal.aborted) {
      say("Many visitors are here. Waiting for a place …");
      await new Promise((resolve) => setTimeout(resolve, 2000));
    }
    if (!answer.ok) throw new Error(await answer.text());
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    let rest = "", ended = false;
    for (;;) {
      const { value, done } = await reader.read();
      if (done) break;
      const lines = (rest + value).split("\n");
      rest = lines.pop();
      for (const line of lines) ended = (await handle(JSON.parse(line), mine)) || ended;
    }
    if (!ended) throw new Error("the answer broke off");
  } catch (error) {
    if (!mine.signal.aborted) say(`The server did not make a mesh (${error.message}). Is it still running?`, true);
  }
}

/** Handle one message of the server; returns whether it is the last that must come. */
async function handle(message, mine) {
  if (message.place) say(message.place === 1 ? "You are next …" : `${message.place} are before you …`);
  if (message.mask) {
    const number = message.of ?? chosen, each = album[number];
    const bits = bytes(message.mask), pixels = each.colors.width * each.colors.height;
    each.mask = Uint8ClampedArray.from({ length: pixels }, (_, i) => (bits[i >> 3] >> (7 - (i & 7))) & 1 ? 255 : 0);
    if (number === chosen) {
      mask = each.mask;
      $("hint").textContent = `Found ${message.how}. ${message.left_out ? `Note: ${message.left_out}. ` : ""}${HINT}`;
    }
    show();
    if (album.length > 1 && message.of === undefined) { // its outline was corrected: now all together
      sendAll();
      return true;
    }
  }
  if (message.progress) { say(WORDS[message.progress]); busy(0.1 + 0.85 * message.part); }
  if (message.error) {
    $("views").innerHTML = '<div class="card view empty"><p class="quiet">The mesh appears here.</p></div>';
    if (message.of !== undefined) turnTo(message.of);
    if (message.tool) choose(message.tool); // the server asks for a box
    say(message.error, true);
  }
  if (message.meshes) {
    const read = await Promise.all(message.meshes.map(async (made) => {
      const glb = bytes(made.glb);
      return { ...made, glb, mesh: await readGlb(glb.buffer) };
    }));
    if (!mine.signal.aborted) present(read, message.unused || {});
  }
  if (message.guess && !mine.signal.aborted) {
    const glb = bytes(message.guess.glb);
    offerGuess({ ...message.guess, glb, mesh: await readGlb(glb.buffer) });
  }
  return Boolean(message.error || message.meshes);
}

let views = []; // for each model: its label, the shown mesh, and how to show another

function present(meshes, unused) {
  busy(false);
  say("Drag the mesh to turn it.");
  for (const [number, reason] of Object.entries(unused)) album[number].unused = reason;
  const left = Object.entries(unused).map(([number, reason]) => `picture ${Number(number) + 1} is left out: ${reason}`);
  const warnings = [...new Set([...left, ...meshes.map((made) => made.warning).filter(Boolean)])];
  $("warning").hidden = !warnings.length;
  $("warning").textContent = `Careful: ${warnings.join("; ")}.`;
  showAlbum();
  $("views").replaceChildren();
  $("downloads").replaceChildren();
  $("downloads").hidden = false;
  views = meshes.map((made) => {
    const view = document.createElement("div"), title = document.createElement("b"), guesses = document.createElement("div");
    const several = meshes.length > 1 ? ` ${made.label}` : "";
    view.className = "card view";
    guesses.className = "row guesses";
    $("views").append(view);
    const entry = { label: made.label, guesses, made, show(shown) {
      const canvas = document.createElement("canvas");
      entry.made = shown;
      title.textContent = [several, shown.kind && `Category: ${shown.kind}${shown.warning ? "?" : ""}`].filter(Boolean).join(" · ");
      view.replaceChildren(canvas, title, guesses);
      new Viewer(canvas, shown.mesh, shown.yaw);
    } };
    entry.show(made);
    offer(`GLB${several} (3D viewers, Blender)`, `${name}${several}.glb`, () => new Blob([entry.made.glb], { type: "model/gltf-binary" }));
    offer(`OBJ${several}`, `${name}${several}.obj`, () => new Blob([toObj(entry.made.mesh)], { type: "model/obj" }));
    return entry;
  });
  offer("Cut-out (PNG)", `${name}.png`, cutout);
}

/** A button for another shape that explains the picture, and one for the first. */
function offerGuess(guess) {
  const entry = views.find((each) => each.label === guess.label), { guesses } = entry;
  for (const made of guesses.children.length ? [guess] : [entry.made, guess]) {
    const button = document.createElement("button");
    button.textContent = `${guesses.children.length ? "Another guess" : "First guess"}: ${made.kind}`;
    button.setAttribute("aria-pressed", String(made === entry.made));
    button.onclick = () => {
      entry.show(made);
      for (const each of guesses.children) each.setAttribute("aria-pressed", String(each === button));
    };
    guesses.append(button);
  }
}

/** The picture with the mask as transparency, as this page and `learn3d reconstruct` read it. */
function cutout() {
  const { width, height } = colors, canvas = Object.assign(document.createElement("canvas"), { width, height });
  const image = new ImageData(colors.data.map((value, i) => (i % 4 === 3 ? mask[i >> 2] : value)), width, height);
  canvas.getContext("2d").putImageData(image, 0, 0);
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}

function offer(label, file, make) {
  const button = document.createElement("button");
  button.textContent = `↓ ${label}`;
  button.onclick = async () => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(await make()), download: file });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  $("downloads").append(button);
}

$("category").onchange = () => { if (album.length) sendAll(); };

// Start

fetch("about").then((answer) => answer.json()).then((about) => {
  ({ side, most } = about);
  for (const kind of about.kinds) $("category").append(new Option(kind, kind));
  $("kinds").textContent = about.kinds.length > 1 ? `${about.kinds.slice(0, -1).join(", ")} or ${about.kinds.at(-1)}` : about.kinds[0];
  for (const example of about.examples) {
    const button = document.createElement("button"), image = document.createElement("img");
    button.title = image.alt = example;
    image.src = `examples/${example}.png`;
    button.append(image);
    button.onclick = () => take([[image.src, example]]);
    $("examples").append(button);
  }
});
