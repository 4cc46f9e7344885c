// Mesh files: reads the GLB of the server, writes OBJ.

/** Positions, normals, colours (sRGB, 0 .. 255) and corners of the only mesh of a GLB file. */
export function readGlb(buffer) {
  const size = new DataView(buffer).getUint32(12, true);
  const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, size)));
  const kinds = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
  const widths = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
  const read = (number) => {
    const accessor = tree.accessors[number], view = tree.bufferViews[accessor.bufferView];
    const start = 28 + size + (view.byteOffset || 0) + (accessor.byteOffset || 0), kind = kinds[accessor.componentType];
    const width = widths[accessor.type], count = accessor.count * width;
    return { values: new kind(buffer.slice(start, start + count * kind.BYTES_PER_ELEMENT)), width };
  };
  const primitive = tree.meshes[0].primitives[0], given = primitive.attributes;
  const points = read(given.POSITION).values, colors = new Float32Array(points.length).fill(170);
  if (given.COLOR_0 !== undefined) {
    const { values, width } = read(given.COLOR_0), most = { 1: 255, 2: 65535, 4: 1 }[values.BYTES_PER_ELEMENT];
    for (let v = 0; v < points.length / 3; v++)
      for (let c = 0; c < 3; c++) colors[3 * v + c] = 255 * Math.pow(values[width * v + c] / most, 1 / 2.2);
  }
  return { points, colors, normals: read(given.NORMAL).values, corners: read(primitive.indices).values };
}

/** A Wavefront file of a mesh; programs that know colours of vertices find them behind the positions. */
export function toObj(mesh) {
  const lines = ["# made by learn3d demo"], number = (value) => value.toFixed(5);
  for (let v = 0; v < mesh.points.length; v += 3) {
    const color = [...mesh.colors.subarray(v, v + 3)].map((value) => (value / 255).toFixed(3));
    lines.push(`v ${[...mesh.points.subarray(v, v + 3)].map(number).join(" ")} ${color.join(" ")}`);
  }
  for (let f = 0; f < mesh.corners.length; f += 3)
    lines.push(`f ${[...mesh.corners.subarray(f, f + 3)].map((corner) => corner + 1).join(" ")}`);
  return lines.join("\n") + "\n";
}
