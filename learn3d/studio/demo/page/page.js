// The page: takes pictures, sends them to its server, and shows the meshes that come back.
import { readGlb, toObj } from "./glb.js";
import { writeGif } from "./gif.js";
import { readPicture, Stage } from "./outline.js";
import { Viewer } from "./viewer.js";

const $ = (id) => document.getElementById(id);
const STAGES = {
  camera: "Finding the camera …", shape: "Finding the shape …",
  surface: "Bending the shape to the outline …", colours: "Adding the colours …",
};
const READY = "Done. Drag to turn it; scroll, or pinch with two fingers, to zoom.";
const BACK = " This is the previous mesh.";
const FRAMES = 36, FRAME_SIDE = 320, FRAME_TIME = 8; // of a turntable; the time in hundredths of a second
const THUMBNAIL = 64; // pixels
const READING = 4000; // milliseconds

let side = 512, current = null, views = [];
let taken = 0; // pictures; one that is read faster than an earlier one stays
let requests = []; // what was sent for this picture: the first one, then a correction each
let kind = null, smooth = false; // what the visitor says about the object
let shown = null; // what belongs to the meshes on the page, for a correction that is cancelled or fails
let clay = false; // new meshes are shown in clay
let held = 0; // the time until which an error stays

const stage = new Stage($("picture"), $("hint"), [...document.querySelectorAll("[data-tool]")], (correction) => {
  requests.push(correction);
  send();
});

function press(button, on) {
  button.ariaPressed = Boolean(on);
}

function makeButton(text, act, into) {
  const button = Object.assign(document.createElement("button"), { textContent: text, onclick: act });
  into.append(button);
  return button;
}

// Taking pictures

async function take(source, title) {
  const mine = ++taken, picture = await readPicture(source, title, side).catch(() => null);
  if (mine !== taken) return;
  if (!picture) return say("This file is not a picture that your browser can open. Try a PNG or JPEG.", true);
  cancel();
  [shown, clay] = [null, false];
  if (stage.picture) [kind, smooth] = [null, false];
  document.body.classList.add("given");
  $("invitation").hidden = true;
  $("stage").hidden = $("tools").hidden = false;
  $("choose").textContent = "Another picture";
  $("choose").classList.remove("primary");
  for (const button of $("examples").children) press(button, button.firstChild.src === source);
  scrollTo(0, 0); // on a phone the examples are below
  stage.show(picture);
  requests = [{ alpha: picture.given }];
  send();
}

function takeFile(files) {
  if (files.length === 1) take(files[0], files[0].name);
  else if (files.length) say(`One picture at a time; ${files.length} came.`, true);
  else say("Drop a picture file. A picture in another page must be saved first.", true);
}

for (const [button, input] of [["choose", "file"], ["photograph", "camera"]]) {
  $(button).onclick = () => $(input).click();
  $(input).onchange = () => { if ($(input).files.length) takeFile($(input).files); $(input).value = ""; };
}
$("invitation").onclick = () => $("file").click();
addEventListener("paste", (event) => { if (event.clipboardData.files.length) takeFile(event.clipboardData.files); });
addEventListener("dragover", (event) => { event.preventDefault(); $("over").hidden = false; });
addEventListener("dragleave", (event) => { if (!event.relatedTarget) $("over").hidden = true; });
addEventListener("drop", (event) => { event.preventDefault(); $("over").hidden = true; takeFile(event.dataTransfer.files); });

// Corrections

$("undo").onclick = () => goBack(requests.length - 1);
$("again").onclick = () => goBack(1);
$("cancel").onclick = () => {
  const waited = $("views").inert;
  cancel();
  say(`Cancelled.${!waited ? "" : shown ? BACK : " “Start over” makes the mesh."}`);
};

/** Take back all corrections from the one with this number on. */
function goBack(number) {
  if (requests[number]) stage.mask = requests[number].before; // for a stroke that comes before the answer
  requests.length = number;
  send();
}

function cancel() {
  current?.abort();
  busy(false);
  restore();
}

/** Go back to the meshes that were there before the work, and to what belongs to them. */
function restore() {
  if (!$("views").inert) return;
  if (!shown) return showNothing();
  $("views").inert = false;
  ({ kind, smooth } = shown);
  requests = [...shown.requests];
  stage.showMask(...shown.outline);
  $("doubt").textContent = shown.doubt;
  $("doubt").hidden = !shown.doubt;
  $("downloads").hidden = false;
  showKind();
  allowUndo();
}

function allowUndo() {
  $("undo").disabled = requests.length < 2;
  $("again").disabled = requests.length < 2 && (shown || $("views").inert);
}

/** Say what the object is, or nothing if `which` was said already. */
function setKind(which) {
  [kind, smooth] = [kind === which ? null : which, false];
  if (stage.picture) send();
  else showKind();
}

function setSmooth() {
  [kind, smooth] = [null, !smooth];
  send();
}

function showKind() {
  for (const button of $("kinds").querySelectorAll("button"))
    press(button, button === $("smooth") ? smooth : button.textContent === kind);
}

// The server's work

function say(text, wrong = false) {
  held = wrong ? performance.now() + READING : 0;
  $("words").textContent = text;
  $("status").classList.toggle("error", wrong);
  if (wrong) $("status").scrollIntoView({ block: "nearest" });
}

/** Say what is in work; an error is left to be read. */
function report(text) {
  if (performance.now() > held) say(text);
}

/** Show the share of the work that is done; true: it is not known, false: nothing is in work. */
function busy(part) {
  document.body.classList.toggle("busy", part !== false);
  $("progress").hidden = $("cancel").hidden = part === false;
  if (typeof part === "number") $("progress").value = part;
  else $("progress").removeAttribute("value");
}

/** Send the picture with its last correction. */
async function send() {
  current?.abort();
  const mine = (current = new AbortController()), { alpha, strokes, box } = requests.at(-1);
  const { width, height, data } = stage.picture.colors, pixels = width * height;
  const body = new Uint8Array(pixels * (strokes ? 5 : 4));
  body.set(data);
  for (let i = 0; i < pixels; i++) body[4 * i + 3] = alpha[i];
  if (strokes) body.set(strokes, 4 * pixels);
  const hints = Object.entries({ box, category: kind, smooth: smooth && 1 }).filter(([, value]) => value);
  const query = new URLSearchParams([["width", width], ["height", height], ...hints]);
  $("downloads").hidden = $("doubt").hidden = true;
  $("views").inert = true;
  allowUndo();
  showKind();
  say("Finding the object …");
  busy(0.05);
  try {
    for await (const message of answer(`mesh?${query}`, body, mine.signal)) await handle(message, mine);
    if (!mine.signal.aborted && !mine.ended) throw new Error("the answer broke off");
  } catch (error) {
    if (mine.signal.aborted) return;
    fail(mine, `The server did not make a mesh (${error.message}). Is it still running?`);
  }
  if (mine.signal.aborted) return;
  busy(false);
  if (mine.shown) say(mine.note || READY);
}

/** The messages of the server, one after the other. */
async function* answer(address, body, signal) {
  const request = { method: "POST", body, signal, headers: { "Content-Type": "application/octet-stream" } };
  let response;
  while ((response = await fetch(address, request)).status === 503 && !signal.aborted) {
    say("Many visitors are here. Waiting for a place …");
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
  if (!response.ok) throw new Error(await response.text());
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  for (let rest = ""; ;) {
    const { value, done } = await reader.read();
    if (done) return;
    const lines = (rest + value).split("\n");
    rest = lines.pop();
    yield* lines.map((line) => JSON.parse(line));
  }
}

/** Say why there is no new mesh, or no further guess. */
function fail(mine, reason) {
  if (mine.shown) return mine.note = `There is no further guess: ${reason}`;
  if (!shown && requests.length > 1) stage.mask = requests.pop().before; // else `restore` takes the correction back
  restore();
  say(`${reason}${shown ? BACK : ""}`, true);
}

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const unpack = (made) => { const glb = bytes(made.glb); return { ...made, glb, mesh: readGlb(glb.buffer) }; };

async function handle(message, mine) {
  if (mine.signal.aborted) return;
  if ("place" in message) report(["Finding the object …", "You are next …"][message.place] ?? `${message.place} are before you …`);
  if (message.mask) {
    mine.outline = [bytes(message.mask), `Found ${message.how}. ${message.left_out ? `Note: ${message.left_out}. ` : ""}`];
    stage.showMask(...mine.outline);
  }
  if (message.tool) stage.choose(message.tool); // the server asks for a box
  if (message.doubt) addDoubt(message.doubt);
  if (message.progress && !mine.shown) { report(STAGES[message.progress]); busy(0.1 + 0.85 * message.part); }
  if (message.meshes) {
    mine.shown = mine.ended = true;
    present(message.meshes.map(unpack));
    const doubt = $("doubt").hidden ? "" : $("doubt").textContent;
    shown = { requests: [...requests], kind, smooth, doubt, outline: mine.outline };
    report("Looking for other guesses …");
    busy(true);
  }
  if (message.guess) addGuess(unpack(message.guess));
  if (message.error) {
    mine.ended = true;
    fail(mine, message.error);
  }
}

// The meshes

function showNothing() {
  [views, shown] = [[], null];
  $("views").inert = false;
  allowUndo();
  $("views").innerHTML = '<div class="card view empty"><p class="quiet">The mesh appears here.</p></div>';
}

function addDoubt(text) {
  $("doubt").textContent = `${$("doubt").hidden ? "" : `${$("doubt").textContent} `}${text}`;
  $("doubt").hidden = false;
}

function present(meshes) {
  $("views").inert = false;
  $("views").replaceChildren();
  $("downloads").replaceChildren();
  $("downloads").hidden = $("smooth").hidden = false;
  for (const text of new Set(meshes.map((made) => made.doubt).filter(Boolean))) addDoubt(`${text[0].toUpperCase()}${text.slice(1)}.`);
  const { name } = stage.picture;
  views = meshes.map((made) => {
    const label = meshes.length > 1 ? ` ${made.label}` : "", view = new View(made, label);
    const file = `${name}${label}`;
    offer(`GLB${label}`, `${file}.glb`, () => new Blob([view.made.glb], { type: "model/gltf-binary" }));
    offer(`OBJ${label}`, `${file}.obj`, () => new Blob([toObj(view.made.mesh)], { type: "model/obj" }));
    offer(`Turntable${label}`, `${file}.gif`, () => writeGif(view.viewer.turntable(FRAMES, FRAME_SIDE), FRAME_TIME));
    return view;
  });
  offer("Cut-out", `${name}.png`, () => new Promise((resolve) => stage.cutOut().toBlob(resolve, "image/png")));
}

/** A mesh of one model, and the buttons to look at it. */
class View {
  constructor(made, label) {
    const card = document.createElement("div"), bar = document.createElement("div");
    card.className = "card view";
    bar.className = "row bar";
    this.canvas = document.createElement("canvas");
    this.title = document.createElement("b");
    this.label = label;
    this.guesses = Object.assign(document.createElement("div"), { className: "row guesses", hidden: true });
    card.append(this.canvas, this.title, bar, this.guesses);
    $("views").append(card);
    this.name(made);
    const viewer = (this.viewer = new Viewer(this.canvas, made.mesh, made.camera));
    const add = (text, name, act) => { makeButton(text, act, bar).ariaLabel = name; };
    add("+", "Zoom in", () => viewer.zoomBy(1.25));
    add("−", "Zoom out", () => viewer.zoomBy(0.8));
    add("Reset", "Reset the view", () => { this.compare(false); viewer.reset(); });
    const inClay = makeButton("Clay", () => press(inClay, clay = viewer.clay = !viewer.clay), bar);
    press(inClay, viewer.clay = clay);
    this.beside = makeButton("Beside the picture", () => this.compare(!viewer.compared), bar);
    this.beside.hidden = !made.camera.axes;
    this.canvas.addEventListener("turned", () => this.compare(false));
    this.compare(false);
  }

  /** Show the picture beside the mesh, which is then seen from its camera. */
  compare(on) {
    this.viewer.compared = on ? stage.framed(this.made.camera.size) : null;
    press(this.beside, on);
  }

  name(made) {
    this.made = made;
    this.title.textContent = [this.label, made.kind && `${made.kind}${made.doubt ? "?" : ""}`].filter(Boolean).join(" · ");
  }

  show(made) {
    this.name(made);
    this.viewer.show(made.mesh, made.camera);
    this.beside.hidden = !made.camera.axes;
    this.compare(this.viewer.compared && made.camera.axes);
  }
}

/** A button for another shape that explains the picture, and one for the first. */
function addGuess(guess) {
  const view = views.find((each) => each.made.label === guess.label), { guesses } = view;
  for (const made of guesses.hidden ? [view.made, guess] : [guess]) {
    const name = `Guess ${guesses.children.length + 1}: ${made.kind}`;
    const button = makeButton(name, () => {
      view.show(made);
      for (const each of guesses.children) press(each, each === button);
    }, guesses);
    button.prepend(view.viewer.thumbnail(made.mesh, made.camera, THUMBNAIL));
    press(button, made === view.made);
  }
  guesses.hidden = false;
}

function offer(label, file, make) {
  makeButton(`↓ ${label}`, async () => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(await make()), download: file });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }, $("downloads"));
}

// Start

showNothing();
fetch("about").then((response) => response.json()).then((about) => {
  ({ side } = about);
  $("ask").hidden = about.kinds.length < 2;
  for (const each of about.kinds.length < 2 ? [] : about.kinds)
    makeButton(each, () => setKind(each), $("kinds")).ariaLabel = `It is a${/^[aeiou]/.test(each) ? "n" : ""} ${each}`;
  $("smooth").onclick = setSmooth;
  $("kinds").append($("smooth"));
  showKind();
  $("trained").textContent = new Intl.ListFormat("en-GB", { type: "disjunction" }).format(about.kinds);
  $("tries").hidden = !about.examples.length;
  for (const example of about.examples) {
    const image = Object.assign(document.createElement("img"), { src: `examples/${example}.png`, alt: example });
    const button = makeButton("", () => take(image.src, example), $("examples"));
    button.title = example;
    button.append(image);
  }
});
