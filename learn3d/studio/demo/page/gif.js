// Writes animated GIF files.

/** A GIF that repeats for ever, of pictures (ImageData, opaque, one size), each shown for `delay` hundredths of a second. */
export function writeGif(frames, delay) {
  const { width, height } = frames[0], short = (value) => [value & 255, value >> 8];
  const { palette, indexOf } = choosePalette(frames);
  const parts = [
    letters("GIF89a"), [...short(width), ...short(height), 0xf7, 0, 0], palette,
    [0x21, 0xff, 11], letters("NETSCAPE2.0"), [3, 1, 0, 0, 0],
  ];
  for (const { data } of frames) {
    const indices = new Uint8Array(width * height);
    for (let i = 0; i < indices.length; i++) indices[i] = indexOf[bin(data, 4 * i)];
    parts.push([0x21, 0xf9, 4, 4, ...short(delay), 0, 0], [0x2c, 0, 0, 0, 0, ...short(width), ...short(height), 0, 8]);
    const packed = compress(indices);
    for (let start = 0; start < packed.length; start += 255) {
      const block = packed.slice(start, start + 255);
      parts.push([block.length], block);
    }
    parts.push([0]);
  }
  return new Blob([...parts, [0x3b]].map((part) => Uint8Array.from(part)), { type: "image/gif" });
}

const letters = (text) => [...text].map((letter) => letter.charCodeAt(0));

/** The colour of a pixel with five bits a channel. */
const bin = (data, i) => ((data[i] >> 3) << 10) | ((data[i + 1] >> 3) << 5) | (data[i + 2] >> 3);

/** The 256 commonest colours, and for each colour that occurs the nearest of them. */
function choosePalette(frames) {
  const count = new Uint32Array(1 << 15), indexOf = new Uint8Array(1 << 15), palette = new Uint8Array(768);
  for (const { data } of frames) for (let i = 0; i < data.length; i += 4) count[bin(data, i)]++;
  const common = [...count.keys()].filter((color) => count[color]).sort((a, b) => count[b] - count[a]);
  const channels = (color) => [10, 5, 0].map((shift) => ((color >> shift) & 31) * 255 / 31);
  common.slice(0, 256).forEach((color, k) => palette.set(channels(color), 3 * k));
  for (const color of common) {
    const [r, g, b] = channels(color);
    let best = Infinity;
    for (let k = 0; k < 256; k++) {
      const far = (palette[3 * k] - r) ** 2 + (palette[3 * k + 1] - g) ** 2 + (palette[3 * k + 2] - b) ** 2;
      if (far < best) [best, indexOf[color]] = [far, k];
    }
  }
  return { palette, indexOf };
}

/** LZW with codes of 9 to 12 bits; 256 clears the table, 257 ends the data. */
function compress(indices) {
  const packed = [], codes = new Map();
  let bits = 0, filled = 0, size = 9, next = 258, prefix = indices[0];
  const put = (code) => {
    bits |= code << filled;
    for (filled += size; filled >= 8; filled -= 8, bits >>= 8) packed.push(bits & 255);
  };
  put(256);
  for (const index of indices.subarray(1)) {
    const key = (prefix << 8) | index, code = codes.get(key);
    if (code !== undefined) { prefix = code; continue; }
    put(prefix);
    prefix = index;
    if (next === 4096) {
      put(256);
      codes.clear();
      [size, next] = [9, 258];
    } else {
      if (next === 1 << size) size++;
      codes.set(key, next++);
    }
  }
  put(prefix);
  put(257);
  if (filled) packed.push(bits & 255);
  return packed;
}
