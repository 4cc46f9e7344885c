// Mesh files: reads the GLB of the server, writes OBJ.

/** Positions, normals, colours (sRGB, 0 .. 255) and corners of the mesh of a GLB file as the server writes it. */
export function readGlb(buffer) {
  const size = new DataView(buffer).getUint32(12, true);
  const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, size)));
  const kinds = { 5121: Uint8Array, 5125: Uint32Array, 5126: Float32Array };
  const read = (number) => {
    const { bufferView, componentType } = tree.accessors[number], { byteOffset = 0, byteLength } = tree.bufferViews[bufferView];
    const start = 28 + size + byteOffset;
    return new kinds[componentType](buffer.slice(start, start + byteLength));
  };
  const { attributes, indices } = tree.meshes[0].primitives[0];
  const points = read(attributes.POSITION), colors = new Float32Array(points.length).fill(170);
  if (attributes.COLOR_0 !== undefined) {
    const rgba = read(attributes.COLOR_0);
    for (let v = 0; v < points.length / 3; v++)
      for (let c = 0; c < 3; c++) colors[3 * v + c] = 255 * Math.pow(rgba[4 * v + c] / 255, 1 / 2.2);
  }
  return { points, colors, normals: read(attributes.NORMAL), corners: read(indices) };
}

/** A Wavefront file of a mesh; programs that know colours of vertices find them behind the positions. */
export function toObj(mesh) {
  const lines = ["# made by learn3d demo"], number = (value) => value.toFixed(5);
  for (let v = 0; v < mesh.points.length; v += 3) {
    const color = [...mesh.colors.subarray(v, v + 3)].map((value) => (value / 255).toFixed(3));
    lines.push(`v ${[...mesh.points.subarray(v, v + 3)].map(number).join(" ")} ${color.join(" ")}`);
  }
  for (let v = 0; v < mesh.normals.length; v += 3)
    lines.push(`vn ${[...mesh.normals.subarray(v, v + 3)].map((value) => value.toFixed(3)).join(" ")}`);
  for (let f = 0; f < mesh.corners.length; f += 3)
    lines.push(`f ${[...mesh.corners.subarray(f, f + 3)].map((corner) => `${corner + 1}//${corner + 1}`).join(" ")}`);
  return lines.join("\n") + "\n";
}
