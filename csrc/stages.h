// The argument struct of each stage: inputs, outputs, sizes, settings. Raw arrays only, row-major.
// Row 0 of an image is the top one, except in clip space (ClipMesh). Stages in the order of a
// render: camera, clip, rasterize, then those that use the face index map: silhouette, fragments,
// depth, shading, resolve. Voxels and losses come last.
#pragma once

#include <cstdint>

namespace nmr {

// The pixels of an image or of a raster.
struct Size {
  int64_t height, width;

  int64_t pixels() const { return height * width; }
  bool operator==(const Size& other) const {
    return height == other.height && width == other.width;
  }
};

// The raster of an image: twice as fine with anti-aliasing.
inline Size raster_of(Size image, bool anti_aliasing) {
  return anti_aliasing ? Size{2 * image.height, 2 * image.width} : image;
}

// Which rows of an array belong to which image. Arrays are [B, N, ...], [N, ...] if all images
// share the rows, or packed: the rows of all images in turn.
struct Rows {
  int64_t size;  // N; packed: rows of all images
  bool each;     // every image has its own
  // packed: the first row of each image at every second place, then N; else nullptr
  const int64_t* starts;

  int64_t first(int64_t b) const { return starts ? starts[2 * b] : each ? b * size : 0; }
  int64_t count(int64_t b) const { return starts ? starts[2 * b + 2] - starts[2 * b] : size; }
  int64_t total(int64_t batch) const { return each && !starts ? batch * size : size; }
};

// A batch of meshes. In renderer space x, y lie in [-1, 1] across the screen (y up) and z is the
// depth.
template <class T>
struct MeshBatch {
  const T* vertices;     // [B, V, 3], or packed [N, 3]
  const int64_t* faces;  // [F, 3] shared, [B, F, 3], or packed [M, 3]; vertex numbers count from
                         // the mesh's own first vertex
  int64_t batch;         // B
  Rows vertex_rows, face_rows;

  const T* image_vertices(int64_t b) const { return vertices + 3 * vertex_rows.first(b); }
  const int64_t* image_faces(int64_t b) const { return faces + 3 * face_rows.first(b); }
};

// A parameter of cameras, or of images: one for all, or one for each.
template <class P>
struct Parameter {
  const P* values;  // [size] or [n, size]; nullptr if it is not given
  bool each;        // [n, size]
  P* grad;          // backward out, like values (summed over cameras if there is one), or nullptr

  const P* of(int64_t camera, int64_t size) const { return values + (each ? camera * size : 0); }
};

// A camera as a row of kCamera numbers: [A | t] (3 x 4, world to camera axes: x right, y down, z
// forward), K (2 x 3, renderer-space x and y), the origin (3) and the extent.
constexpr int64_t kCamera = 12 + 6 + 3 + 1, kIntrinsics = 12, kOrigin = 18, kExtent = 21;

// World space to renderer space (camera.cpp). The cameras are poses, or given by their parts.
//
// A pose (look_at.cpp) looks from `eye` at a point or along a direction: rows x, -y, z of A; z =
// n(forward), x = n(up x z), y = n(z x x), n(v) = v / max(|v|, 1e-5); t = 0, the origin is the eye.
// If forward or up is not finite or beyond 1e15, A and t are NaN and get no gradient. Parameters
// are doubles; the difference at - eye and the angle are rounded to T before anything is computed
// from them, as published.
//
// Per image b: u = A (v - origin) + t; then
//   perspective:   p = (u_x / u_z, u_y / u_z), distorted as OpenCV does (distortion.h); q = p /
//   extent;
//                  out = (K00 q_x + K01 q_y + K02, K10 q_x + ...,
//                  u_z)
//   orthographic:  the same with p = (u_x, u_y), without distortion.
// Origin and extent are separate parameters so that poses round as the published ones: images and
// gradients then have the same bits. A vertex has no finite image if it is not finite itself, if it
// is in the plane of the eye, if x / z^2 overflows, or if the camera is not finite. It then gets
// out = (inf, inf, any finite number), so that its faces are not drawn, and gradient 0.
template <class T>
struct Project {
  const T* vertices;  // [B or 1, V, 3], or packed [N, 3]
  Rows vertex_rows;
  int64_t batch;    // B, of the output
  int64_t cameras;  // n: B or 1
  bool perspective;

  Parameter<double> eye, at, up;  // of poses [3]; else not given
  Parameter<double> view;  // []: half of the field of view in degrees, else the scale: then extent
                           // = tan(view), or K is multiplied by the scale
  bool along;              // `at` is a direction
  bool right_handed;       // x points to the other side

  Parameter<T> matrix, intrinsics;  // the parts: [A | t] and K
  Parameter<T> origin, extent;      // 0 and 1 if they are not given
  T across, down;                   // factors of the rows of K

  Parameter<T> distortion;  // [coefficients], may be missing
  int64_t coefficients;     // 5: k1 k2 p1 p2 k3; 8: also k4 k5 k6; 4: k1 k2 k3 k4 of a fisheye

  T* camera;             // forward out, backward in [n, kCamera]: the cameras as rows
  T* points;             // forward out [B, V, 3] or [N, 3]
  T* nearest;            // forward out []: the least depth of all points, which are never NaN
  const T* grad_camera;  // backward in, or nullptr
  const T* grad_points;  // backward in, or nullptr
  T* grad_vertices;      // backward out, like vertices (summed over images that share them), or
                         // nullptr
  int num_threads;
};

// Near-plane clipping (clip.cpp): how much room the drawn meshes need ...
template <class T>
struct ClipCount {
  MeshBatch<T> mesh;
  T near;           // faces are cut at this depth
  int64_t* counts;  // out [B, 2]: new vertices, drawn faces. A mesh that stays as it is: 0, F
  int num_threads;
};

// ... and the faces that are drawn, packed. Room that is left over is filled with faces without
// area.
template <class T>
struct ClipFaces {
  MeshBatch<T> mesh;
  T near;
  const int64_t*
      starts;       // [B + 1, 2]: first new vertex and first drawn face of each mesh, then P and M
  int64_t* faces;   // out [M, 3]: vertices of the mesh; its new vertices are numbered after its own
  int32_t* source;  // out [M]: the face of the mesh that a drawn face is part of
  int64_t* corners;  // out [M, 3]: k < 3: corner k of that face; 3 + p: new vertex p of the mesh
  int64_t* ends;  // out [P, 4]: a new vertex is between two rows of `vertices`, which are these two
                  // corners of its face
  int num_threads;
};

// Settings of the rasterizer.
template <class T>
struct RasterSettings {
  Size raster;              // pixels of the raster: H x W
  bool fill_back;           // draws every face also with its vertex order reversed
  T near;                   // pixels with depth <= near are not drawn
  T far;                    // nor those with depth >= far
  bool perspective = true;  // see Fragments
};

// The nearest face at each pixel, and the share of each pixel that is covered (rasterize.cpp).
template <class T>
struct Rasterize {
  MeshBatch<T> mesh;
  RasterSettings<T> settings;
  int32_t* face_index;  // out [B, H, W]; -1 background, f front, F + f reversed copy of f
  int num_threads;
  T* alpha = nullptr;          // out [B, h, w], or nullptr: the covered share of each pixel
  bool anti_aliasing = false;  // of alpha: the mean of 2x2 pixels
};

// The K nearest faces at each pixel, nearest first (layers.cpp).
template <class T>
struct RasterizeLayers {
  MeshBatch<T> mesh;
  RasterSettings<T> settings;
  int64_t layers;       // K
  int32_t* face_index;  // out [B, H, W, K]; as in Rasterize, -1 after the last face
  int num_threads;
};

// NMR's gradient of a silhouette (edge_gradient.cpp), or that of Kato and Harada 2019
// (local_gradient.cpp).
template <class T>
struct SilhouetteBackward {
  MeshBatch<T> mesh;
  Size image;  // h x w
  bool anti_aliasing;
  T eps;  // NMR's: keeps the distance to an edge away from zero; local: if rates differ by less,
          // the gradient is 0
  const int32_t* face_index;  // [B, H, W]
  const T* grad_alpha;        // [B, h, w]
  T* grad_vertices;           // out, like mesh.vertices; z gets 0
  int num_threads;
};

// The soft silhouette of SoftRas (soft.cpp): alpha = 1 - transmittance, transmittance = the product
// of 1 - D over all faces.
template <class T>
struct SoftSettings {
  RasterSettings<T> raster;  // faces wholly nearer than near or farther than far are left out
  T sigma;  // D = sigmoid(+-d^2 / sigma), + inside; d in units of half the shorter side of the
            // raster
  T reach;  // faces whose border is at d^2 >= reach from a pixel outside are left out there
};

template <class T>
struct SoftForward {
  MeshBatch<T> mesh;
  SoftSettings<T> settings;
  T* transmittance;  // out [B, H, W]
  int num_threads;
};

template <class T>
struct SoftBackward {
  MeshBatch<T> mesh;
  SoftSettings<T> settings;
  const T* transmittance;       // [B, H, W] of the forward pass
  const T* grad_transmittance;  // [B, H, W]
  T* grad_vertices;             // out, like mesh.vertices; z gets 0
  T* grad_sigma;                // out [B]
  int num_threads;
};

// The K nearest of the faces that reach a pixel, nearest first (soft.cpp). The depth of a face at a
// pixel outside is that of SoftWeights (soft_weights.h); faces without area are left out.
// settings.sigma may be any positive number.
template <class T>
struct SoftLayers {
  MeshBatch<T> mesh;
  SoftSettings<T> settings;
  int64_t layers;       // K
  int32_t* face_index;  // out [B, H, W, K]; -1 after the last face, F + f: face f seen from behind
  int num_threads;
};

// Weights, depth and distance of the faces that SoftLayers finds, and their derivatives
// (soft_fragments.cpp).
template <class T>
struct SoftFragments {
  MeshBatch<T> mesh;
  Size raster;                // H x W
  int64_t layers;             // K
  T far;                      // depth of the background
  bool perspective;           // see Fragments
  const int32_t* face_index;  // [B, H, W, K]
  T* weights;    // forward out [B, H, W, K, 3], of the face's vertices in their own order
  T* depth;      // forward out [B, H, W, K]
  T* distances;  // forward out [B, H, W, K]: d^2 of a pixel outside, -d^2 inside; background: 0
  const T* grad_weights;  // backward in, as the outputs
  const T* grad_depth;
  const T* grad_distances;
  T* grad_vertices;  // backward out, like mesh.vertices
  int num_threads;
};

// Barycentric weights and depth of the nearest face at each pixel, and their derivatives
// (fragments.cpp). On the screen 1 / depth is linear with perspective, and depth itself without.
// A depth image has no weights, and with anti-aliasing depths averaged over 2x2 pixels.
template <class T>
struct Fragments {
  MeshBatch<T> mesh;
  Size image;                 // h x w
  bool anti_aliasing;         // only of a depth image
  T far;                      // depth of the background
  const int32_t* face_index;  // [B, H, W]
  T* weights;  // forward out [B, H, W, 3]: of the face's own vertices 0, 1, 2, in space; 0 on
               // background. nullptr: a depth image
  T* depth;    // forward out [B, h, w]
  const T* grad_weights;  // backward in [B, H, W, 3], or nullptr
  const T* grad_depth;    // backward in [B, h, w], or nullptr
  T* grad_vertices;       // backward out, like mesh.vertices
  int num_threads;
  bool perspective = true;
};

// Colours from texture cubes (shade.cpp): axis k of a cube is the weight of the face's vertex k.
template <class T>
struct TextureCubes {
  const int32_t* face_index;  // [B, H, W]
  const T* weights;           // [B, H, W, 3] of Fragments
  int64_t batch;
  Size raster;           // H x W
  const T* textures;     // [B or 1, F, ts, ts, ts, C], or packed [M, ts, ts, ts, C]
  Rows cubes;            // a cube for each face
  int64_t texture_size;  // ts; a cube of one texel is constant
  int64_t channels;      // C
  T eps;                 // coordinates are clamped to [0, ts - 1 - eps]
  T* colors;             // forward out [B, H, W, C]; 0 on background
  const T* grad_colors;  // backward in
  T* grad_textures;      // backward out, like textures
  int num_threads;
};

// Values given at the corners of faces, interpolated over the pixels (shade.cpp).
template <class T>
struct Interpolate {
  const int32_t* face_index;  // [B, H, W]
  const T* weights;           // [B, H, W, 3] of Fragments
  int64_t batch;
  Size raster;             // H x W
  const T* attributes;     // [B or 1, N, C], or packed [N, C]
  Rows rows;               // of attributes
  int64_t channels;        // C
  const int64_t* corners;  // [F, 3] shared, [B, F, 3], or packed [M, 3]: rows of attributes,
                           // counted from the mesh's first
  Rows face_rows;          // of corners
  T* values;               // forward out [B, H, W, C]; 0 on background
  const T* grad_values;    // backward in
  T* grad_attributes;      // backward out, like attributes, or nullptr
  T* grad_weights;         // backward out [B, H, W, 3], or nullptr
  int num_threads;
};

// How a texture continues outside [0, 1].
enum class Wrap : int { repeat, clamp, mirror };

// Mipmaps of texture images (texture.cpp): each level has half the size of the one before, rounded
// down, until it is one texel. A texel is the mean of the part of the finer level that it covers.
// Smaller images repeat their last level.
template <class T>
struct Mipmaps {
  int64_t images, levels;  // I, L
  const int64_t* grids;    // [I, L, 3]: first texel, height, width of each level in the pyramid
  int64_t channels;        // C
  const T* texels;         // the images end to end [., C]
  T* pyramid;              // forward out [., C]: level 0 is the image itself
  const T* grad_pyramid;   // backward in
  T* grad_texels;          // backward out, like texels
  int num_threads;
};

// Colours from texture images at interpolated uv coordinates (texture.cpp); bilinear, and linear
// between mipmaps if level is given. A coordinate that is not finite, or not below 1e6, counts as
// 0.
template <class T>
struct SampleUV {
  Interpolate<T> uv;       // attributes: the uv coordinates, 2 channels
  const T* texels;         // [N, C], images (or pyramids) end to end
  int64_t num_texels;      // N
  int64_t channels;        // C
  const int64_t* grids;    // [I, L, 3]: first texel, height, width of each level of each image
  int64_t images, levels;  // I is 1 (shared) or B; L
  const T* level;          // [B, H, W] in [0, L - 1], or nullptr: level 0 everywhere
  Wrap wrap;
  T* colors;             // forward out [B, H, W, C]; 0 on background
  const T* grad_colors;  // backward in
  T* grad_texels;        // backward out, like texels, or nullptr
};

// The mipmap level of each pixel (texture.cpp), as OpenGL defines it: log2 of the number of texels
// that the pixel spans, from the derivatives of uv on the screen, clamped to the levels that there
// are.
template <class T>
struct UVLevels {
  Interpolate<T> uv;     // as in SampleUV
  MeshBatch<T> mesh;     // in renderer space
  const int64_t* grids;  // as in SampleUV
  int64_t images, levels;
  T* level;  // out [B, H, W]; 0 on background
};

// Meshes in clip space, as OpenGL has it, and which of their faces is nearest at each pixel. Row 0
// is the bottom.
template <class T>
struct ClipMesh {
  const T* positions;         // [B or 1, V, 4]: x, y, z, w
  Rows rows;                  // of positions
  const int64_t* faces;       // [F, 3]
  int64_t num_faces;          // F
  const int32_t* face_index;  // [B, H, W]
  int64_t batch;
  Size raster;
  int num_threads;
};

// Barycentric weights and z / w (clip_space.cpp): (b_0, b_1, z / w, face + 1), and the derivatives
// of b_0 and b_1 by pixel coordinates (db_0/dX, db_0/dY, db_1/dX, db_1/dY). 0 on background. z / w
// has no gradient.
template <class T>
struct ClipWeights {
  ClipMesh<T> mesh;
  T* rast;               // forward out [B, H, W, 4]
  T* slopes;             // forward out [B, H, W, 4]
  const T* grad_rast;    // backward in
  const T* grad_slopes;  // backward in, or nullptr
  T* grad_positions;     // backward out, like positions
};

// Pixels blended at silhouette edges (clip_space.cpp). Of two neighbours with different faces, the
// nearer one's face may have a silhouette edge that crosses the line between their centres at a
// distance d from its own centre, in pixels. If d > 1/2 the other pixel gets the share d - 1/2 of
// the nearer one's colour, else the nearer one 1/2 - d of the other's.
template <class T>
struct Antialias {
  ClipMesh<T> mesh;
  const T* rast;  // [B, H, W, 4] of ClipWeights
  const int64_t*
      twins;  // [F, 3]: edge 3 f + k is opposite to corner k of face f. Its entry is the next edge
              // with the same two vertices, cyclically: itself if there is no other
  int64_t channels;       // C
  const T* colors;        // [B, H, W, C]
  T* blended;             // forward out [B, H, W, C]
  const T* grad_blended;  // backward in
  T* grad_colors;         // backward out, or nullptr
  T* grad_positions;      // backward out, like positions; or nullptr
};

// Unit normals of meshes in world space (normals.cpp): n((v0 - v1) x (v2 - v1)) of faces, or of
// vertices the direction of the sum of these products over the faces around them. 0 without an
// area. A vertex that is not finite, or beyond 1e100, counts as the origin and gets no gradient.
template <class T>
struct Normals {
  MeshBatch<T> mesh;
  bool smooth;            // normals of vertices, else of faces
  T* normals;             // forward out [B or 1, F, 3], packed [M, 3]; smooth: like mesh.vertices
  const T* grad_normals;  // backward in
  T* grad_vertices;       // backward out, like mesh.vertices
  int num_threads;
};

// The parameters of lights, in this order in `layout`. Each has a row for every image or one for
// all, and in a row a number, or a vector of three, for every light or one for all.
enum class LightParameter : int {
  ambient,
  ambient_color,
  directional,
  directional_color,
  direction,
  point,
  point_color,
  position,
  falloff,
  specular,
  shininess,
  count
};

// Lit colours, or the normals themselves, at each pixel (lights.cpp). With n the unit normal of the
// side that is seen, x the point:
//   lit = color (ambient ambient_color + sum over lights of c relu(n . l)) + highlight,
//   highlight = specular sum over lights with n . l > 0 of c relu(r . v)^shininess, r = 2 (n . l) n
//   - l,
//               v towards the eye;
// a directional light has l = direction, c = directional directional_color (in highlights l is the
// unit vector, and c is multiplied by its length); a point light has l towards position, of length
// 1, and c = point point_color / (1 + falloff |position - x|^2).
template <class T>
struct LitColors {
  Interpolate<T> at;  // attributes: vertices in world space, 3 channels, corners: the faces;
                      // grad_attributes, grad_weights
  const T* normals;   // [B or 1, F, 3], packed [M, 3]; smooth: like the vertices
  Rows normal_rows;
  bool smooth;  // normals of vertices, interpolated: sum of b_k n_k, divided by its length or 1e-5
  const T* viewer;  // [B, 5]: place of the eye, 1; or direction towards the viewer, 0; then -1 if
                    // the camera sees a right-handed world (Pinhole), else 1
  const T* parameters;  // all lights, or nullptr: the result is the normal
  const int64_t*
      layout;  // [LightParameter::count, 3]: first value, rows (1 or B), lights (may be 0)
  int64_t num_parameters;
  const T* colors;     // [B, H, W, C], or nullptr: white
  int64_t channels;    // C: 1 or 3
  T* lit;              // forward out [B, H, W, 3]; 0 on background
  const T* grad_lit;   // backward in
  T* grad_colors;      // backward out [B, H, W, C], or nullptr
  T* grad_normals;     // backward out, like normals, or nullptr
  T* grad_parameters;  // backward out [num_parameters], or nullptr
};

// From raster pixels to image pixels: the mean of 2x2 with anti-aliasing, else a copy (edges.cpp).
template <class T>
struct Resolve {
  int64_t batch;
  Size image;  // h x w
  bool anti_aliasing;
  int64_t channels;           // C
  const int32_t* face_index;  // [B, H, W]
  const T* pixels;            // [B, H, W, C] of the raster
  Parameter<T> background;    // [C] colour of pixels without a face; not given: that in `pixels`
  T* resolved;                // forward out [B, h, w, C]
  const T* grad_resolved;     // backward in
  T* grad_pixels;  // backward out [B, H, W, C], or nullptr; 0 at background pixels if `background`
                   // is given
  T* grad_background;  // backward out [B, C], or nullptr
  int num_threads;
};

// The gradient of the edges in an image with any channels: NMR's (edges.cpp): pixels pull every
// visible edge whose motion over them lowers the loss, or the local one (local_gradient.cpp).
template <class T>
struct EdgesBackward {
  MeshBatch<T> mesh;
  Size image;  // h x w
  bool anti_aliasing;
  T eps;
  const int32_t* face_index;  // [B, H, W]
  const T* pixels;            // [B, H, W, C]
  int64_t channels;           // C
  Parameter<T> background;    // [C] colour of pixels without a face; not given: that in `pixels`
  const T* grad_resolved;     // [B, h, w, C]
  T* grad_vertices;           // out, like mesh.vertices; z gets 0
  int num_threads;
  bool perspective;  // kind of the cameras; only the local gradient reads it
};

// Occupancy grids (voxelize.cpp).
struct Voxelize {
  MeshBatch<float> mesh;  // vertices in [0, 1]^3
  int64_t size;           // s
  bool touched;  // surface cells: all that a face touches (kato19); else those of rays and vertices
                 // (kato18)
  bool* voxels;  // out [B, s, s, s]
  int num_threads;
};

// Smoothness loss per mesh (smoothness.cpp).
template <class T>
struct Smoothness {
  const T* vertices;     // [B, V, 3]
  const int64_t* edges;  // [E, 4]: the edge's two vertices, then the two opposite ones
  int64_t batch, num_vertices, num_edges;
  T* loss;             // forward out [B]
  const T* grad_loss;  // backward in [B]
  T* grad_vertices;    // backward out [B, V, 3]
  int num_threads;
};

// Soft intersection over union of pairs of images (soft_iou.cpp).
template <class T>
struct SoftIou {
  const T* prediction;  // [B, N]
  const T* target;      // [B, N]
  int64_t batch, count;
  double* areas;       // forward out, backward in [B, 2]: I and U
  T* iou;              // forward out [B]
  T* target_range;     // forward out [2]: the least and the largest of all targets, 0 and 1
  const T* grad_iou;   // backward in [B]
  T* grad_prediction;  // backward out [B, N], or nullptr
  T* grad_target;      // backward out [B, N], or nullptr
  int num_threads;
};

template <class T>
void look_at(const Project<T>& args);  // fills `camera`
template <class T>
void look_at_backward(const Project<T>& args, const T* grad_camera);
template <class T>
void project_forward(const Project<T>& args);
template <class T>
void project_backward(const Project<T>& args);
template <class T>
void clip_count(const ClipCount<T>& args);
template <class T>
void clip_faces(const ClipFaces<T>& args);
template <class T>
void rasterize(const Rasterize<T>& args);
template <class T>
void rasterize_layers(const RasterizeLayers<T>& args);
template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args);
template <class T>
void local_gradient(const SilhouetteBackward<T>& args);
template <class T>
void local_edges_backward(const EdgesBackward<T>& args);
template <class T>
void soft_forward(const SoftForward<T>& args);
template <class T>
void soft_backward(const SoftBackward<T>& args);
template <class T>
void soft_layers(const SoftLayers<T>& args);
template <class T>
void soft_fragments_forward(const SoftFragments<T>& args);
template <class T>
void soft_fragments_backward(const SoftFragments<T>& args);
template <class T>
void fragments_forward(const Fragments<T>& args);
template <class T>
void fragments_backward(const Fragments<T>& args);
template <class T>
void texture_cubes_forward(const TextureCubes<T>& args);
template <class T>
void texture_cubes_backward(const TextureCubes<T>& args);
template <class T>
void interpolate_forward(const Interpolate<T>& args);
template <class T>
void interpolate_backward(const Interpolate<T>& args);
template <class T>
void mipmaps_forward(const Mipmaps<T>& args);
template <class T>
void mipmaps_backward(const Mipmaps<T>& args);
template <class T>
void sample_uv_forward(const SampleUV<T>& args);
template <class T>
void sample_uv_backward(const SampleUV<T>& args);
template <class T>
void uv_levels(const UVLevels<T>& args);
template <class T>
void clip_weights_forward(const ClipWeights<T>& args);
template <class T>
void clip_weights_backward(const ClipWeights<T>& args);
template <class T>
void antialias_forward(const Antialias<T>& args);
template <class T>
void antialias_backward(const Antialias<T>& args);
template <class T>
void normals_forward(const Normals<T>& args);
template <class T>
void normals_backward(const Normals<T>& args);
template <class T>
void lit_forward(const LitColors<T>& args);
template <class T>
void lit_backward(const LitColors<T>& args);
template <class T>
void resolve_forward(const Resolve<T>& args);
template <class T>
void resolve_backward(const Resolve<T>& args);
template <class T>
void edges_backward(const EdgesBackward<T>& args);
template <class T>
void smoothness_forward(const Smoothness<T>& args);
template <class T>
void smoothness_backward(const Smoothness<T>& args);
template <class T>
void soft_iou_forward(const SoftIou<T>& args);
template <class T>
void soft_iou_backward(const SoftIou<T>& args);
void voxelize(const Voxelize& args);

// Compiles a stage for float and double, behind its definition.
#define NMR_FLOAT_AND_DOUBLE(stage, Args)       \
  template void stage(const Args<float>& args); \
  template void stage(const Args<double>& args);

}  // namespace nmr
