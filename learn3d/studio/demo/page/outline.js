// The visitor's picture with the outline of its object, and the tools that correct it.

const HINT = "Outline wrong? Correct it on the picture:";
const HINTS = {
  box: "Drag a box around the object.",
  add: "Paint over the missing part.",
  remove: "Paint over the part that does not belong to it.",
};
const KEYS = " Arrow keys move the cross, with Shift by one pixel; the space bar begins and ends.";
const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const OBJECT = 1, BACKGROUND = 2, OPEN = 3; // the values of learn3d.studio.picture_to_mesh.cutting
const BRUSH = 12, REACH = 34; // radii in pixels: of a stroke, and of the region around it in which the outline may move
const LEAST = 8; // pixels of a side of a box

/** Read a picture with sides of at most `side` pixels: { name, colors, given }; given: its transparency, 255 where it has none. */
export async function readPicture(source, title, side) {
  const image = new Image();
  image.src = typeof source === "string" ? source : URL.createObjectURL(source);
  await image.decode();
  if (typeof source !== "string") URL.revokeObjectURL(image.src);
  const scale = side / Math.max(image.naturalWidth, image.naturalHeight);
  if (!(scale > 0 && scale < Infinity)) throw new Error("it has no size");
  const width = Math.max(1, Math.round(image.naturalWidth * scale)), height = Math.max(1, Math.round(image.naturalHeight * scale));
  const context = canvasOf(width, height).getContext("2d", { willReadFrequently: true });
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
  };
}

const canvasOf = (width, height) => Object.assign(document.createElement("canvas"), { width, height });

/** The picture on the page. */
export class Stage {
  picture = null; // see `readPicture`
  mask = null; // of its object, bytes 0 or 255; null if not known yet
  #tool = null;
  #drag = null;
  #cross = null; // a point that keys move
  #outline = null; // a canvas
  #found = "";

  /** correct({ alpha, strokes, box, before }) is called for each correction; before: the mask that was shown, or null. */
  constructor(canvas, hint, buttons, correct) {
    Object.assign(this, { canvas, hint, buttons, correct });
    for (const button of buttons)
      button.onclick = (event) => {
        this.choose(this.#tool === button.dataset.tool ? null : button.dataset.tool);
        if (this.#tool && !event.detail) this.#takeKeys(); // a key has pressed the button
      };
    this.area = canvas.parentElement; // a box may begin beside the picture
    this.area.onkeydown = (event) => this.#press(event);
    this.area.onpointerdown = (event) => {
      this.#drag = this.#cross = null; // a second finger ends a stroke
      if (!this.#tool) return;
      if (event.button || !event.isPrimary) return this.#draw();
      this.area.setPointerCapture(event.pointerId);
      this.#drag = [this.#at(event)];
      this.#draw();
    };
    this.area.onpointermove = (event) => { if (this.#drag) { this.#drag.push(this.#at(event)); this.#draw(); } };
    this.area.onpointercancel = () => { this.#drag = null; this.#draw(); };
    this.area.onpointerup = () => this.#finish();
  }

  show(picture) {
    Object.assign(this, { picture, mask: null });
    Object.assign(this.canvas, { width: picture.colors.width, height: picture.colors.height });
    [this.#outline, this.#found] = [null, ""];
    this.choose(null);
    this.#draw();
  }

  /** Show the mask that was found, one bit a pixel, with words how. */
  showMask(bits, found) {
    this.mask = Uint8ClampedArray.from({ length: this.picture.given.length }, (_, i) => (bits[i >> 3] >> (7 - (i & 7))) & 1 ? 255 : 0);
    this.#outline = drawOutline(this.mask, this.canvas.width, this.canvas.height);
    this.#found = found;
    this.choose(this.#tool);
    this.#draw();
  }

  choose(tool) {
    if (tool !== this.#tool) this.#drag = this.#cross = null; // what is drawn belongs to the tool that began it
    this.#tool = tool;
    this.area.classList.toggle("tool", Boolean(tool));
    this.area.tabIndex = this.#cross ? 0 : -1;
    this.hint.textContent = `${this.#found}${HINTS[tool] || HINT}${this.#cross ? KEYS : ""}`;
    for (const button of this.buttons) button.ariaPressed = button.dataset.tool === tool;
  }

  /** The picture with the mask as transparency, as the page and `learn3d reconstruct` read it. */
  cutOut() {
    const { width, height, data } = this.picture.colors, canvas = canvasOf(width, height);
    const cut = data.map((value, i) => (i % 4 === 3 ? this.mask[i >> 2] : value));
    canvas.getContext("2d").putImageData(new ImageData(cut, width, height), 0, 0);
    return canvas;
  }

  /** The object in the middle of a square; the larger side of its box takes `share` of the square's. */
  framed(share) {
    const { width } = this.picture.colors, found = [...this.mask.keys()].filter((i) => this.mask[i]);
    const xs = found.map((i) => i % width), left = xs.reduce((a, b) => Math.min(a, b)), right = xs.reduce((a, b) => Math.max(a, b)) + 1;
    const top = Math.floor(found[0] / width), low = Math.floor(found.at(-1) / width) + 1;
    const side = Math.ceil(Math.max(right - left, low - top) / share), canvas = canvasOf(side, side);
    canvas.getContext("2d").drawImage(this.cutOut(), side / 2 - (left + right) / 2, side / 2 - (top + low) / 2);
    return canvas;
  }

  #takeKeys() {
    this.#cross = [this.canvas.width / 2, this.canvas.height / 2];
    this.choose(this.#tool);
    this.area.focus();
    this.#draw();
  }

  #press(event) {
    const move = MOVES[event.key];
    if (!this.#cross || !(move || event.key === " ")) return;
    event.preventDefault(); // the page does not scroll
    if (!move && this.#drag) return this.#finish();
    const most = [this.canvas.width, this.canvas.height], step = event.shiftKey ? 1 : Math.max(...most) / 40;
    if (move) this.#cross = this.#cross.map((value, axis) => Math.min(most[axis], Math.max(0, value + step * move[axis])));
    if (move) this.#drag?.push(this.#cross);
    else this.#drag = [this.#cross];
    this.#draw();
  }

  #at(event) {
    const place = this.canvas.getBoundingClientRect(), part = (value, most) => Math.min(most, Math.max(0, value * most));
    return [part((event.clientX - place.left) / place.width, this.canvas.width), part((event.clientY - place.top) / place.height, this.canvas.height)];
  }

  #finish() {
    if (!this.#drag) return;
    const points = this.#drag, box = boxOf(points), { given } = this.picture, tool = this.#tool;
    this.#drag = null;
    this.#draw();
    if (tool === "box" && Math.min(box[2], box[3]) > LEAST) this.correct({ alpha: given, box, before: this.mask });
    if (tool === "box") return;
    const alpha = this.mask || new Uint8ClampedArray(given.length);
    const strokes = this.#strokes(points, tool === "add" ? OBJECT : BACKGROUND);
    this.correct({ alpha, strokes, before: this.mask });
    // until the server answers, so that a further stroke does not undo this one
    this.mask = alpha.map((value, i) => ({ [OBJECT]: 255, [BACKGROUND]: 0 })[strokes[i]] ?? value);
  }

  /** The label of each pixel after a stroke, see learn3d.studio.picture_to_mesh.cutting. */
  #strokes(points, value) {
    const { width, height } = this.canvas, strokes = new Uint8Array(width * height);
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

  #draw() {
    const context = this.canvas.getContext("2d");
    context.putImageData(this.picture.colors, 0, 0);
    if (this.#outline) context.drawImage(this.#outline, 0, 0);
    this.#drawDrag(context);
    if (this.#cross) drawCross(context, ...this.#cross);
  }

  #drawDrag(context) {
    if (!this.#drag) return;
    if (this.#tool === "box") {
      context.setLineDash([8, 6]);
      for (const [color, shift] of [["#000", 0], ["#fff", 7]]) {
        Object.assign(context, { strokeStyle: color, lineWidth: 2, lineDashOffset: shift });
        context.strokeRect(...boxOf(this.#drag));
      }
      context.setLineDash([]);
      return;
    }
    Object.assign(context, { strokeStyle: this.#tool === "add" ? "#19b35acc" : "#e0364ccc", lineWidth: 2 * BRUSH, lineCap: "round", lineJoin: "round" });
    context.beginPath();
    for (const [x, y] of [this.#drag[0], ...this.#drag]) context.lineTo(x, y);
    context.stroke();
  }
}

/** The outline of a mask: white inside of its border, dark outside, so that any picture shows it. */
function drawOutline(mask, width, height) {
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
  const canvas = canvasOf(width, height);
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

function drawCross(context, x, y) {
  for (const [strokeStyle, lineWidth] of [["#000", 6], ["#fff", 3]]) {
    Object.assign(context, { strokeStyle, lineWidth });
    context.beginPath();
    for (const [u, v] of [[16, 0], [0, 16]]) {
      context.moveTo(x - u, y - v);
      context.lineTo(x + u, y + v);
    }
    context.stroke();
  }
}

function boxOf(points) {
  const [[x, y], [u, v]] = [points[0], points.at(-1)];
  const [left, top] = [Math.min(x, u), Math.min(y, v)].map(Math.round);
  const [right, bottom] = [Math.max(x, u), Math.max(y, v)].map(Math.round);
  return [left, top, right - left, bottom - top];
}
