// A turning mesh in colour, drawn by the CPU on a canvas: it needs no WebGL and looks the same everywhere.

const SPEED = 0.5; // radians a second
const REST = 4000; // milliseconds after the user's last move
const LIGHT = [-0.44, 0.62, 0.65]; // right, up, towards the eye
const CLAY = [196, 190, 182];
const NEAREST = 4.2; // distance of the eye from the mesh, over the mesh's reach
const ZOOMS = [0.5, 4];

/** Shows a mesh. It turns by itself, but not for some seconds after the user has turned it. */
export class Viewer {
  clay = false; // without its colours
  compared = null; // a picture that is shown beside the mesh, as its camera sees the mesh
  #fingers = new Map();

  /** camera: of the mesh's picture, see `show`. */
  constructor(canvas, mesh, camera) {
    this.canvas = canvas;
    this.still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.show(mesh, camera);
    this.reset();
    Object.assign(canvas, { tabIndex: 0, role: "img", ariaLabel: "The mesh; arrow keys turn it, + and - zoom, 0 resets the view" });
    this.#listen();
    const step = (time) => {
      if (!canvas.isConnected) return; // another page is shown
      const turns = !this.still && !this.#fingers.size && !this.compared && time > this.waitUntil;
      if (turns) this.yaw += SPEED * Math.min(0.1, (time - this.last) / 1000);
      this.last = time;
      const view = [this.yaw, this.pitch, this.zoom, this.clay, this.compared !== null, canvas.clientWidth, canvas.clientHeight].join();
      const changed = view !== this.shown || this.mesh !== this.drawn;
      if (canvas.clientWidth && (changed || this.coarse)) this.#draw(turns || (changed && this.#fingers.size > 0));
      [this.shown, this.drawn] = [view, this.mesh];
      requestAnimationFrame(step);
    };
    this.last = performance.now();
    requestAnimationFrame(step);
  }

  /** Show a mesh from the same side. camera: of its picture: { yaw, pitch } and, if it is known well, { axes, distance, shift, focus }. */
  show(mesh, camera) {
    Object.assign(this, { mesh, camera, low: 0, reach: 1e-6 });
    for (let v = 0; v < mesh.points.length; v += 3) {
      this.low = Math.min(this.low, mesh.points[v + 1]);
      this.reach = Math.max(this.reach, Math.hypot(...mesh.points.subarray(v, v + 3)));
    }
    this.seen = new Float32Array(mesh.points.length); // x, y in pixels, nearness
    this.lit = new Float32Array(mesh.points.length);
  }

  /** Look from the picture's camera. */
  reset() {
    Object.assign(this, { yaw: this.camera.yaw, pitch: this.camera.pitch, zoom: 1, quality: 2 });
    this.waitUntil = performance.now() + 1200;
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + pitch));
    this.#touched();
  }

  zoomBy(factor) {
    this.zoom = Math.min(ZOOMS[1], Math.max(ZOOMS[0], this.zoom * factor));
    this.#touched();
  }

  #touched() {
    this.waitUntil = performance.now() + REST;
    if (this.compared) this.canvas.dispatchEvent(new Event("turned"));
  }

  #listen() {
    const { canvas } = this, fingers = this.#fingers;
    const span = () => { const [[x, y], [u, v]] = fingers.values(); return Math.hypot(u - x, v - y) || 1; };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const wide = fingers.size === 2 && span();
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (wide) this.zoomBy(span() / wide);
      else if (fingers.size === 1) this.turn((before[0] - event.clientX) * 0.01, (event.clientY - before[1]) * 0.01);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    // one finger may scroll the page up and down, two must not
    canvas.addEventListener("touchmove", (event) => { if (event.touches.length > 1) event.preventDefault(); }, { passive: false });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY * 0.001));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => this.turn(0.15, 0), ArrowRight: () => this.turn(-0.15, 0), ArrowUp: () => this.turn(0, 0.15), ArrowDown: () => this.turn(0, -0.15),
      "+": () => this.zoomBy(1.2), "-": () => this.zoomBy(1 / 1.2), 0: () => this.reset(),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  #draw(moves) {
    const start = performance.now(), { canvas } = this, ratio = Math.min(2, devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d"), fine = Math.min(2, 1500 / Math.max(width, height));
    this.coarse = moves && this.quality < fine;
    context.clearRect(0, 0, width, height);
    if (this.compared) this.#drawPair(context, width, height, fine);
    else this.#drawMesh(context, width, height, moves ? Math.min(this.quality, fine) : fine);
    const took = performance.now() - start; // draw fewer pixels of moving meshes on slow devices
    if (moves) this.quality = Math.min(2, Math.max(0.6, this.quality * (took > 45 ? 0.8 : took < 15 ? 1.1 : 1)));
  }

  /** The picture, and beside or below it the mesh from the picture's camera. */
  #drawPair(context, width, height, scale) {
    const wide = width > height, w = wide ? width / 2 : width, h = wide ? height : height / 2, side = Math.min(w, h);
    context.imageSmoothingQuality = "high";
    context.drawImage(this.compared, (w - side) / 2, (h - side) / 2, side, side);
    const image = this.#render(Math.round(w * scale), Math.round(h * scale), this.#pictureCamera(w * scale, h * scale));
    context.drawImage(image, wide ? w : 0, wide ? 0 : h, w, h);
  }

  #drawMesh(context, width, height, scale) {
    const shadow = this.#orbitCamera(width, height);
    this.#drawShadow(context, width, height, shadow);
    const w = Math.round(width * scale), h = Math.round(height * scale);
    context.imageSmoothingQuality = "high";
    context.drawImage(this.#render(w, h, this.#orbitCamera(w, h)), 0, 0, width, height);
  }

  /** Pictures (ImageData) of one turn of the mesh on white. */
  turntable(count, side) {
    const canvas = Object.assign(document.createElement("canvas"), { width: side, height: side });
    const context = canvas.getContext("2d", { willReadFrequently: true }), { yaw, zoom } = this;
    this.zoom = 1;
    const frames = Array.from({ length: count }, (_, k) => {
      this.yaw = yaw + 2 * Math.PI * k / count;
      context.fillStyle = "#fff";
      context.fillRect(0, 0, side, side);
      this.#drawMesh(context, side, side, 2);
      return context.getImageData(0, 0, side, side);
    });
    Object.assign(this, { yaw, zoom });
    return frames;
  }

  /** A small picture of another mesh, from its picture's camera. */
  thumbnail(mesh, camera, side) {
    const canvas = Object.assign(document.createElement("canvas"), { width: side, height: side }), before = { ...this };
    this.show(mesh, camera);
    Object.assign(this, { yaw: camera.yaw, pitch: camera.pitch, zoom: 1 });
    this.#drawMesh(canvas.getContext("2d"), side, side, 2);
    Object.assign(this, before);
    return canvas;
  }

  // A camera: its axes [right, up, towards the eye], its distance, pixels per unit at distance 1, shift of the mesh to the right and up.

  #orbitCamera(width, height) {
    const cy = Math.cos(this.yaw), sy = Math.sin(this.yaw), cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
    const axes = [[cy, 0, -sy], [-sp * sy, cp, -sp * cy], [cp * sy, sp, cp * cy]];
    const focus = 0.46 * this.zoom * Math.min(width, height) * Math.sqrt(NEAREST ** 2 - 1);
    return { axes, distance: NEAREST * this.reach, focus, shift: [0, 0] };
  }

  #pictureCamera(width, height) {
    const { axes, distance, shift, focus } = this.camera;
    return { axes, distance, shift, focus: focus * Math.min(width, height) };
  }

  /** The mesh on a transparent canvas, until the next call. */
  #render(width, height, camera) {
    const canvas = (this.fine ||= document.createElement("canvas"));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    if (this.image?.width !== width || this.image.height !== height) {
      this.image = new ImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.near = new Float32Array(width * height);
    }
    this.pixels.fill(0);
    this.near.fill(0);
    this.#place(width, height, camera);
    this.#fill(width, height);
    canvas.getContext("2d").putImageData(this.image, 0, 0);
    return canvas;
  }

  #place(width, height, { axes: [right, up, eye], distance, focus, shift }) {
    const { points, normals, colors } = this.mesh, { seen, lit, clay } = this;
    const light = [0, 1, 2].map((k) => LIGHT[0] * right[k] + LIGHT[1] * up[k] + LIGHT[2] * eye[k]);
    for (let v = 0; v < points.length; v += 3) {
      const x = points[v], y = points[v + 1], z = points[v + 2], n = normals[v], m = normals[v + 1], o = normals[v + 2];
      const near = 1 / (distance - (x * eye[0] + y * eye[1] + z * eye[2]));
      seen[v] = width / 2 + focus * near * (x * right[0] + y * right[1] + z * right[2] + shift[0]);
      seen[v + 1] = height / 2 - focus * near * (x * up[0] + y * up[1] + z * up[2] + shift[1]);
      seen[v + 2] = near;
      const side = n * eye[0] + m * eye[1] + o * eye[2] < 0 ? -1 : 1; // both sides are lit
      const facing = side * (n * light[0] + m * light[1] + o * light[2]);
      const shade = (clay ? 0.45 : 0.62) + (clay ? 0.6 : 0.42) * Math.max(0, facing) + 0.06 * Math.min(0, facing);
      const gloss = clay ? 0 : 10 * Math.max(0, facing);
      for (let c = 0; c < 3; c++) lit[v + c] = Math.min(255, (clay ? CLAY[c] : colors[v + c]) * shade + gloss);
    }
  }

  /** Draw the triangles with interpolated colours and a depth buffer. */
  #fill(width, height) {
    const { corners } = this.mesh, { seen, lit, pixels, near } = this;
    for (let f = 0; f < corners.length; f += 3) {
      const a = 3 * corners[f], b = 3 * corners[f + 1], c = 3 * corners[f + 2];
      const ax = seen[a], ay = seen[a + 1], bx = seen[b], by = seen[b + 1], cx = seen[c], cy = seen[c + 1];
      const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
      if (!area) continue;
      const left = Math.max(0, Math.ceil(Math.min(ax, bx, cx) - 0.5)), top = Math.max(0, Math.ceil(Math.min(ay, by, cy) - 0.5));
      const end = Math.min(width - 1, Math.floor(Math.max(ax, bx, cx) - 0.5)), low = Math.min(height - 1, Math.floor(Math.max(ay, by, cy) - 0.5));
      const bdx = (cy - ay) / area, bdy = (ax - cx) / area, cdx = (ay - by) / area, cdy = (bx - ax) / area;
      const na = seen[a + 2], nb = seen[b + 2] - na, nc = seen[c + 2] - na;
      const ra = lit[a], rb = lit[b] - ra, rc = lit[c] - ra, ga = lit[a + 1], gb = lit[b + 1] - ga, gc = lit[c + 1] - ga;
      const ba = lit[a + 2], bb = lit[b + 2] - ba, bc = lit[c + 2] - ba;
      for (let y = top; y <= low; y++) {
        const dy = y + 0.5 - ay;
        let p = (left + 0.5 - ax) * bdx + dy * bdy, q = (left + 0.5 - ax) * cdx + dy * cdy; // shares of b and c
        for (let x = left, i = y * width + left; x <= end; x++, i++, p += bdx, q += cdx) {
          if (p < -1e-5 || q < -1e-5 || p + q > 1.00001) continue;
          const n = na + p * nb + q * nc;
          if (n <= near[i]) continue;
          near[i] = n;
          pixels[i] = 0xff000000 | ((ba + p * bb + q * bc) << 16) | ((ga + p * gb + q * gc) << 8) | (ra + p * rb + q * rc);
        }
      }
    }
  }

  /** A soft shadow on the ground: a small picture of the points' projections, enlarged. */
  #drawShadow(context, width, height, { axes: [right, up, eye], distance, focus }) {
    if (this.pitch < 0.05) return; // seen from below the ground
    const { points } = this.mesh, cell = Math.max(width, height) / 72, w = Math.ceil(width / cell), h = Math.ceil(height / cell);
    const dark = new Float32Array(w * h), y = this.low, add = 72 * 72 * 14 / points.length;
    for (let v = 0; v < points.length; v += 6) {
      const x = points[v], z = points[v + 2], near = 1 / (distance - (x * eye[0] + y * eye[1] + z * eye[2]));
      const column = (width / 2 + focus * near * (x * right[0] + z * right[2])) / cell;
      const row = (height / 2 - focus * near * (x * up[0] + y * up[1] + z * up[2])) / cell;
      if (column >= 1 && row >= 1 && column < w - 1 && row < h - 1) dark[Math.floor(row) * w + Math.floor(column)] += add;
    }
    const image = new ImageData(w, h), small = (this.small ||= document.createElement("canvas"));
    for (let i = w + 1; i < w * h - w - 1; i++) {
      let sum = 0;
      for (const d of [0, 0, 1, -1, w, -w, w + 1, w - 1, -w - 1, 1 - w]) sum += Math.min(16, dark[i + d]);
      image.data[4 * i + 3] = Math.min(50, 1.8 * sum);
    }
    Object.assign(small, { width: w, height: h });
    small.getContext("2d").putImageData(image, 0, 0);
    context.imageSmoothingQuality = "high";
    context.filter = `blur(${cell}px)`; // coarser in browsers without filters
    context.drawImage(small, 0, 0, w * cell, h * cell);
    context.filter = "none";
  }
}
