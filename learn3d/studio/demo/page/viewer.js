// A turning mesh in colour, drawn by the CPU on a canvas: it needs no WebGL and looks the same everywhere.
"use strict";

/** Positions, normals, colours (sRGB, 0 .. 255), corners and texture of the only mesh of a GLB file. */
async function readGlb(buffer) {
  const head = new DataView(buffer), size = head.getUint32(12, true);
  const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, size)));
  const binary = 28 + size, kinds = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
  const widths = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
  const read = (number) => {
    const accessor = tree.accessors[number], view = tree.bufferViews[accessor.bufferView];
    const start = binary + (view.byteOffset || 0) + (accessor.byteOffset || 0), kind = kinds[accessor.componentType];
    const count = accessor.count * widths[accessor.type];
    return { values: new kind(buffer.slice(start, start + count * kind.BYTES_PER_ELEMENT)), width: widths[accessor.type] };
  };
  const primitive = tree.meshes[0].primitives[0], given = primitive.attributes;
  const points = read(given.POSITION).values, colors = new Float32Array(points.length).fill(170);
  if (given.COLOR_0 !== undefined) {
    const { values, width } = read(given.COLOR_0), most = values instanceof Uint8Array ? 255 : values instanceof Uint16Array ? 65535 : 1;
    for (let v = 0; v < points.length / 3; v++)
      for (let c = 0; c < 3; c++) colors[3 * v + c] = 255 * Math.pow(values[width * v + c] / most, 1 / 2.2);
  }
  const mesh = { points, normals: read(given.NORMAL).values, colors, corners: read(primitive.indices).values };
  if (tree.images) {
    const { byteOffset, byteLength } = tree.bufferViews[tree.images[0].bufferView], start = binary + (byteOffset || 0);
    const { width, height, data } = await decode(buffer.slice(start, start + byteLength));
    Object.assign(mesh, { uv: read(given.TEXCOORD_0).values, texture: { width, height, texels: data } });
    for (let v = 0; v < points.length / 3; v++) colors.set(data.subarray(texel(mesh.texture, mesh.uv[2 * v], mesh.uv[2 * v + 1])).subarray(0, 3), 3 * v);
  }
  return mesh;
}

async function decode(content) {
  const image = await createImageBitmap(new Blob([content])), { width, height } = image;
  const context = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d");
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, width, height);
}

/** Position of R of the texel at (u, v), v from the top. */
function texel({ width, height }, u, v) {
  return 4 * (Math.min(height - 1, Math.max(0, Math.floor(v * height))) * width + Math.min(width - 1, Math.max(0, Math.floor(u * width))));
}

/** A Wavefront file of a mesh; programs that know colours of vertices find them behind the positions. */
function toObj(mesh) {
  const lines = ["# made by learn3d demo"], number = (value) => value.toFixed(5);
  for (let v = 0; v < mesh.points.length; v += 3) {
    const color = [...mesh.colors.subarray(v, v + 3)].map((value) => (value / 255).toFixed(3));
    lines.push(`v ${[...mesh.points.subarray(v, v + 3)].map(number).join(" ")} ${color.join(" ")}`);
  }
  for (let f = 0; f < mesh.corners.length; f += 3)
    lines.push(`f ${[...mesh.corners.subarray(f, f + 3)].map((corner) => corner + 1).join(" ")}`);
  return lines.join("\n") + "\n";
}

/** Shows one mesh on a canvas. It turns by itself, but not for some seconds after the user has turned it. */
class Viewer {
  static SPEED = 0.5; // radians a second
  static REST = 4000; // milliseconds after the user's last move
  static LIGHT = [-0.44, 0.62, 0.65]; // right, up, towards the eye

  constructor(canvas, mesh, yaw) {
    Object.assign(this, { canvas, mesh, yaw, pitch: 0.3, zoom: 1, quality: 2 });
    this.still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.waitUntil = performance.now() + 1200; // at first the mesh is seen from the picture's camera
    this.fine = document.createElement("canvas");
    this.measure();
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The mesh; drag it or use the arrow keys to turn it");
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); this.held = true; });
    canvas.addEventListener("pointermove", (event) => {
      if (this.held) this.turn(-event.movementX * 0.01, event.movementY * 0.01);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { this.held = false; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom = Math.min(4, Math.max(0.5, this.zoom * Math.exp(-event.deltaY * 0.001)));
      this.turn(0, 0);
    }, { passive: false });
    const keys = { ArrowLeft: [0.15, 0], ArrowRight: [-0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] };
    canvas.addEventListener("keydown", (event) => {
      if (keys[event.key]) { event.preventDefault(); this.turn(...keys[event.key]); }
    });
    const step = (time) => {
      if (!canvas.isConnected) return; // another mesh is shown
      const turning = !this.still && !this.held && time > this.waitUntil;
      if (turning) this.yaw += Viewer.SPEED * Math.min(0.1, (time - this.last) / 1000);
      this.last = time;
      const view = [this.yaw, this.pitch, this.zoom, canvas.clientWidth, canvas.clientHeight].join();
      if (view !== this.shown && canvas.clientWidth) this.draw();
      this.shown = view;
      requestAnimationFrame(step);
    };
    this.last = performance.now();
    requestAnimationFrame(step);
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + pitch));
    this.waitUntil = performance.now() + Viewer.REST;
  }

  measure() {
    const { points } = this.mesh;
    this.low = 0;
    let most = 0;
    for (let v = 0; v < points.length; v += 3) {
      this.low = Math.min(this.low, points[v + 1]);
      most = Math.max(most, Math.hypot(points[v], points[v + 1], points[v + 2]));
    }
    this.reach = most || 1;
    this.seen = new Float32Array(points.length); // x, y in pixels, nearness
    this.lit = new Float32Array(points.length);
  }

  draw() {
    const start = performance.now(), { canvas, fine } = this, ratio = Math.min(2, devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const scale = Math.max(0.5, Math.min(this.quality, 1500 / Math.max(width, height)));
    const w = Math.round(width * scale), h = Math.round(height * scale);
    if (fine.width !== w || fine.height !== h || !this.image) {
      Object.assign(fine, { width: w, height: h });
      this.image = new ImageData(w, h);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.near = new Float32Array(w * h);
    }
    this.pixels.fill(0);
    this.near.fill(0);
    this.place(w, h);
    this.fill(w, h);
    fine.getContext("2d").putImageData(this.image, 0, 0);
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    this.drawShadow(context, width, height);
    context.imageSmoothingQuality = "high";
    context.drawImage(fine, 0, 0, width, height);
    const took = performance.now() - start; // draw fewer pixels on slow devices
    if (took > 45) this.quality = Math.max(0.6, this.quality * 0.8);
  }

  /** The camera: its axes [right, up, towards the eye], its distance, pixels per unit at distance 1. */
  camera(width, height) {
    const cy = Math.cos(this.yaw), sy = Math.sin(this.yaw), cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
    const distance = 4.2 * this.reach;
    const axes = [[cy, 0, -sy], [-sp * sy, cp, -sp * cy], [cp * sy, sp, cp * cy]];
    return { axes, distance, focus: 0.46 * this.zoom * Math.min(width, height) * Math.sqrt(4.2 ** 2 - 1) };
  }

  place(width, height) {
    const { points, normals, colors, texture } = this.mesh, { seen, lit } = this, { axes, distance, focus } = this.camera(width, height);
    const [right, up, eye] = axes, light = [0, 1, 2].map((k) => Viewer.LIGHT[0] * right[k] + Viewer.LIGHT[1] * up[k] + Viewer.LIGHT[2] * eye[k]);
    for (let v = 0; v < points.length; v += 3) {
      const x = points[v], y = points[v + 1], z = points[v + 2], n = normals[v], m = normals[v + 1], o = normals[v + 2];
      const near = 1 / (distance - (x * eye[0] + y * eye[1] + z * eye[2]));
      seen[v] = width / 2 + focus * near * (x * right[0] + z * right[2]);
      seen[v + 1] = height / 2 - focus * near * (x * up[0] + y * up[1] + z * up[2]);
      seen[v + 2] = near;
      const side = n * eye[0] + m * eye[1] + o * eye[2] < 0 ? -1 : 1; // both sides are lit
      const facing = side * (n * light[0] + m * light[1] + o * light[2]);
      const shade = 0.62 + 0.42 * Math.max(0, facing) + 0.06 * Math.min(0, facing);
      const gloss = 10 * Math.max(0, facing);
      for (let c = 0; c < 3; c++) lit[v + c] = texture ? shade : Math.min(255, colors[v + c] * shade + gloss);
    }
  }

  /** Draw the triangles with interpolated or textured colours and a depth buffer. */
  fill(width, height) {
    const { corners, uv, texture } = this.mesh, { seen, lit, pixels, near } = this, texels = texture?.texels;
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
      const [ua, va, ub, vb, uc, vc] = texture ? [a, b, c].flatMap((v) => [uv[2 * v / 3], uv[2 * v / 3 + 1]]) : [];
      for (let y = top; y <= low; y++) {
        const dy = y + 0.5 - ay;
        let p = (left + 0.5 - ax) * bdx + dy * bdy, q = (left + 0.5 - ax) * cdx + dy * cdy; // shares of b and c
        for (let x = left, i = y * width + left; x <= end; x++, i++, p += bdx, q += cdx) {
          if (p < -1e-5 || q < -1e-5 || p + q > 1.00001) continue;
          const n = na + p * nb + q * nc;
          if (n <= near[i]) continue;
          near[i] = n;
          if (texture) {
            const light = ra + p * rb + q * rc, r = 1 - p - q;
            const t = texel(texture, r * ua + p * ub + q * uc, r * va + p * vb + q * vc);
            const red = Math.min(255, light * texels[t]), green = Math.min(255, light * texels[t + 1]);
            pixels[i] = 0xff000000 | (Math.min(255, light * texels[t + 2]) << 16) | (green << 8) | red;
            continue;
          }
          pixels[i] = 0xff000000 | ((ba + p * bb + q * bc) << 16) | ((ga + p * gb + q * gc) << 8) | (ra + p * rb + q * rc);
        }
      }
    }
  }

  /** A soft shadow on the ground: a small picture of the points' projections, enlarged. */
  drawShadow(context, width, height) {
    if (this.pitch < 0.05) return; // seen from below the ground
    const { points } = this.mesh, { axes, distance, focus } = this.camera(width, height), [right, up, eye] = axes;
    const cell = Math.max(width, height) / 72, w = Math.ceil(width / cell), h = Math.ceil(height / cell);
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
      image.data[4 * i + 3] = Math.min(64, 1.8 * sum);
    }
    Object.assign(small, { width: w, height: h });
    small.getContext("2d").putImageData(image, 0, 0);
    context.imageSmoothingQuality = "high";
    context.filter = `blur(${cell}px)`; // coarser in browsers without filters
    context.drawImage(small, 0, 0, w * cell, h * cell);
    context.filter = "none";
  }
}
