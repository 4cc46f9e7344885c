// Lights on the visible faces, and their normals. struct LitColors in stages.h has the definition.
//
// Where the light depends only on the face (flat, no point lights, no highlights) it is computed
// once per visible face.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "corner_values.h"
#include "powers.h"
#include "vectors.h"

namespace nmr {
namespace {

// v / |v| and |v|; 0 if it has no length. The backward pass is that of the unit vector alone.
template <class T>
struct Unit {
  Vec3<T> unit;
  T length;

  explicit Unit(const Vec3<T>& v) : unit(Vec3<T>::Zero()), length(v.norm()) {
    if (length > 0 && length <= std::numeric_limits<T>::max()) unit = v / length;
  }
  Vec3<T> backward(const Vec3<T>& grad) const { return unit_backward<T>(unit, length, 0, grad); }
};

// One light of an image, directional or a point, and the gradients of the same.
template <class T>
struct Light {
  bool point;
  T intensity;
  Vec3<T> color, place;  // place: direction, or position
  T falloff;
};

// All light of an image; as gradients, the sums over its pixels.
template <class T>
struct Lights {
  T ambient, specular, shininess;
  Vec3<T> ambient_color;
  std::vector<Light<T>> each;
  bool highlights;

  void set_zero() {
    ambient = specular = shininess = 0;
    ambient_color.setZero();
    for (Light<T>& light : each) {
      light.intensity = light.falloff = 0;
      light.color.setZero();
      light.place.setZero();
    }
  }
};

// Calls body(first value in `parameters`, value) for every parameter of image b.
template <class T, class Body>
void for_parameters(const LitColors<T>& args, int64_t b, Lights<T>& lights, const Body& body) {
  const auto at = [&](LightParameter name, int64_t n, int64_t width) {
    const int64_t* l = args.layout + 3 * static_cast<int>(name);
    return l[0] + ((l[1] == 1 ? 0 : b) * l[2] + (l[2] == 1 ? 0 : n)) * width;
  };
  const auto one = [&](LightParameter name, int64_t n, T& value) { body(at(name, n, 1), value); };
  const auto three = [&](LightParameter name, int64_t n, Vec3<T>& value) {
    for (int k = 0; k < 3; ++k) body(at(name, n, 3) + k, value[k]);
  };
  one(LightParameter::ambient, 0, lights.ambient);
  three(LightParameter::ambient_color, 0, lights.ambient_color);
  int64_t directional = 0, points = 0;
  for (Light<T>& light : lights.each) {
    const int64_t n = light.point ? points++ : directional++;
    one(light.point ? LightParameter::point : LightParameter::directional, n, light.intensity);
    three(light.point ? LightParameter::point_color : LightParameter::directional_color, n,
          light.color);
    three(light.point ? LightParameter::position : LightParameter::direction, n, light.place);
    if (light.point) one(LightParameter::falloff, n, light.falloff);
  }
  if (lights.highlights) {
    one(LightParameter::specular, 0, lights.specular);
    one(LightParameter::shininess, 0, lights.shininess);
  }
}

// Number of lights of a kind: the largest of its parameters, 0 if one has none.
template <class T>
int64_t light_count(const LitColors<T>& args, LightParameter first, int64_t parameters) {
  int64_t most = 0;
  for (int64_t n = 0; n < parameters; ++n) {
    const int64_t count = args.layout[3 * (static_cast<int64_t>(first) + n) + 2];
    if (count == 0) return 0;
    most = std::max(most, count);
  }
  return most;
}

template <class T>
Lights<T> lights_of(const LitColors<T>& args, int64_t b) {
  Lights<T> lights{};
  lights.ambient_color.setZero();
  if (!args.parameters) return lights;
  const Light<T> zero{false, 0, Vec3<T>::Zero(), Vec3<T>::Zero(), 0};
  lights.each.assign(light_count(args, LightParameter::directional, 3), zero);
  const size_t directional = lights.each.size();
  lights.each.resize(directional + light_count(args, LightParameter::point, 4), zero);
  for (size_t n = directional; n < lights.each.size(); ++n) lights.each[n].point = true;
  lights.highlights = light_count(args, LightParameter::specular, 2) > 0;
  for_parameters(args, b, lights, [&](int64_t n, T& value) { value = args.parameters[n]; });
  return lights;
}

// Whether the light varies over a face.
template <class T>
bool uses_position(const LitColors<T>& args) {
  return args.parameters && (light_count(args, LightParameter::point, 4) > 0 ||
                             light_count(args, LightParameter::specular, 2) > 0);
}

// What a pixel shows: its point, normal and the direction towards the eye.
template <class T>
struct SurfacePoint {
  Vec3<T> point, normal, eye;
};

// The light that a surface reflects in its own colour, and that of its highlights.
template <class T>
struct PixelLight {
  Vec3<T> diffuse, highlight;
};

// relu(r . v)^shininess with r = 2 (n . l) n - l, for a unit vector l with n . l > 0.
template <class T>
struct Highlight {
  Vec3<T> reflected;
  T cosine, x, value;
  double log2_x = 0;

  Highlight(const SurfacePoint<T>& surface, const Vec3<T>& l, T shininess)
      : cosine(surface.normal.dot(l)), value(0) {
    reflected = 2 * cosine * surface.normal - l;
    x = reflected.dot(surface.eye);
    if (!(x > 0)) return;
    log2_x = log2_of(static_cast<double>(x));
    value = static_cast<T>(exp2_of(shininess * log2_x));
  }
  // Adds the gradients of the normal, of l and of the direction towards the eye.
  void backward(const SurfacePoint<T>& surface, const Vec3<T>& l, T shininess, T grad,
                SurfacePoint<T>& grads, Vec3<T>& grad_l, T& grad_shininess) const {
    if (!(x > 0)) return;
    grad_shininess += static_cast<T>(grad * value * log2_x * 0.69314718055994531);
    const T grad_x = grad * shininess * (value / x);
    const Vec3<T> grad_reflected = grad_x * surface.eye;
    grads.eye += grad_x * reflected;
    const T grad_cosine = 2 * surface.normal.dot(grad_reflected);
    grads.normal += 2 * cosine * grad_reflected + grad_cosine * l;
    grad_l += grad_cosine * surface.normal - grad_reflected;
  }
};

template <class T>
PixelLight<T> light_at(const Lights<T>& lights, const SurfacePoint<T>& surface, bool highlights) {
  PixelLight<T> reflected{lights.ambient * lights.ambient_color, Vec3<T>::Zero()};
  for (const Light<T>& light : lights.each) {
    const Vec3<T> towards = light.point ? Vec3<T>(light.place - surface.point) : light.place;
    if (!(surface.normal.dot(towards) > 0)) continue;
    const Vec3<T> color = light.intensity * light.color;
    if (!light.point && !highlights) {
      reflected.diffuse += surface.normal.dot(towards) * color;
      continue;
    }
    const Unit<T> l(towards);
    const T strength = light.point ? 1 / (1 + light.falloff * towards.squaredNorm()) : l.length;
    reflected.diffuse +=
        (light.point ? strength * surface.normal.dot(l.unit) : surface.normal.dot(towards)) * color;
    if (highlights)
      reflected.highlight += lights.specular * strength *
                             Highlight<T>(surface, l.unit, lights.shininess).value * color;
  }
  return reflected;
}

// Adds the gradients of the lights and of the surface (its normal, point and direction towards the
// eye).
template <class T>
void light_backward(const Lights<T>& lights, const SurfacePoint<T>& surface,
                    const PixelLight<T>& grad, Lights<T>& grad_lights,
                    SurfacePoint<T>& grad_surface) {
  grad_lights.ambient += grad.diffuse.dot(lights.ambient_color);
  grad_lights.ambient_color += lights.ambient * grad.diffuse;
  for (size_t n = 0; n < lights.each.size(); ++n) {
    const Light<T>& light = lights.each[n];
    Light<T>& grad_light = grad_lights.each[n];
    const Vec3<T> towards = light.point ? Vec3<T>(light.place - surface.point) : light.place;
    if (!(surface.normal.dot(towards) > 0)) continue;
    const Vec3<T> color = light.intensity * light.color;
    Vec3<T> grad_color = Vec3<T>::Zero(), grad_towards = Vec3<T>::Zero(), grad_l = Vec3<T>::Zero();
    T grad_strength = 0;
    const Unit<T> l(towards);
    const T square = towards.squaredNorm(),
            strength = light.point ? 1 / (1 + light.falloff * square) : l.length;
    const T colored = grad.diffuse.dot(color);
    if (light.point) {
      const T cosine = surface.normal.dot(l.unit);
      grad_color += strength * cosine * grad.diffuse;
      grad_strength += colored * cosine;
      grad_surface.normal += colored * strength * l.unit;
      grad_l += colored * strength * surface.normal;
    } else {
      grad_color += surface.normal.dot(towards) * grad.diffuse;
      grad_surface.normal += colored * towards;
      grad_towards += colored * surface.normal;
    }
    if (lights.highlights) {
      const Highlight<T> h(surface, l.unit, lights.shininess);
      const T shine = grad.highlight.dot(color);
      grad_color += lights.specular * strength * h.value * grad.highlight;
      grad_lights.specular += shine * strength * h.value;
      grad_strength += shine * lights.specular * h.value;
      h.backward(surface, l.unit, lights.shininess, shine * lights.specular * strength,
                 grad_surface, grad_l, grad_lights.shininess);
    }
    grad_light.intensity += grad_color.dot(light.color);
    grad_light.color += light.intensity * grad_color;
    grad_towards += l.backward(grad_l);
    if (light.point) {
      const T grad_square = -grad_strength * strength * strength;
      grad_light.falloff += grad_square * square;
      grad_towards += 2 * grad_square * light.falloff * towards;
      grad_surface.point -= grad_towards;
    } else {
      grad_towards += grad_strength * l.unit;
    }
    grad_light.place += grad_towards;
  }
}

// --- pixels

constexpr double kShortestNormal =
    1e-5;  // an interpolated normal that is shorter stays short: its gradient is finite

// Pointers to the values of image b, and the sign of its front normals.
template <class T>
struct View {
  ImageAttributes image;
  const T *vertices, *normals, *viewer;
  int64_t first_normal;  // row of normals
  T side;                // factor of normals of faces that are seen from their front

  View(const LitColors<T>& args, int64_t b)
      : image(image_attributes(args.at, b)), viewer(args.viewer + 5 * b), side(viewer[4]) {
    vertices = args.at.attributes + 3 * image.first_row;
    first_normal = args.normal_rows.first(b);
    normals = args.normals + 3 * first_normal;
  }
};

// A pixel: its face, the sign of its normal, and the interpolated normal before it is normalised.
template <class T>
struct Pixel {
  const int64_t* corners;
  int64_t face;
  T sign;
  Vec3<T> mean;
  T length;  // length of the mean normal, at least 1e-5; smooth only
  Unit<T> to_eye{Vec3<T>::Zero()};
  SurfacePoint<T> surface;
};

template <class T>
NMR_INLINE Pixel<T> pixel_of(const LitColors<T>& args, const View<T>& view, int64_t id,
                             const T* weights, bool position) {
  const int64_t F = view.image.num_faces;
  Pixel<T> p;
  p.face = face_of(id, F);
  p.corners = view.image.corners + 3 * p.face;
  p.sign = id < F ? view.side : -view.side;
  p.length = 1;
  if (args.smooth) {
    p.mean.setZero();
    for (int k = 0; k < 3; ++k) p.mean += weights[k] * load3(view.normals + 3 * p.corners[k]);
    p.length = std::max(p.mean.norm(), T(kShortestNormal));
  } else {
    p.mean = load3(view.normals + 3 * p.face);
  }
  p.surface.normal = p.sign * (p.mean / p.length);
  p.surface.point.setZero();
  p.surface.eye.setZero();
  if (position) {
    for (int k = 0; k < 3; ++k)
      p.surface.point += weights[k] * load3(view.vertices + 3 * p.corners[k]);
    p.to_eye = Unit<T>(load3(view.viewer) - view.viewer[3] * p.surface.point);
    p.surface.eye = p.to_eye.unit;
  }
  return p;
}

constexpr int64_t kLitSums = 18;  // per visible face: of the normal (smooth: of three corners), of
                                  // the positions of the corners

// The sums of a block: of visible faces, and of the lights.
template <class T>
struct LitSums : FaceSums<T> {
  std::vector<T> faces;  // [count, 3] light of each face, or its gradient
  Lights<T> lights;
};

// The gradients of one pixel, or of one face if all its pixels are lit alike (weights: nullptr).
template <class T>
NMR_INLINE void pixel_backward(const LitColors<T>& args, const View<T>& view,
                               const Lights<T>& lights, const Pixel<T>& p, const T* weights,
                               const PixelLight<T>& grad, bool position, Lights<T>& grad_lights,
                               T* sums, T* grad_weights) {
  SurfacePoint<T> grad_surface{Vec3<T>::Zero(), Vec3<T>::Zero(), Vec3<T>::Zero()};
  if (args.parameters)
    light_backward(lights, p.surface, grad, grad_lights, grad_surface);
  else
    grad_surface.normal = grad.diffuse;
  Vec3<T> grad_mean = p.sign * grad_surface.normal;
  if (args.smooth)
    grad_mean = unit_backward<T>(p.mean / p.length, p.length, T(kShortestNormal), grad_mean);
  if (position) grad_surface.point -= view.viewer[3] * p.to_eye.backward(grad_surface.eye);
  if (!args.smooth) add3(sums, grad_mean);
  for (int k = 0; weights && k < 3; ++k) {
    T by_weight = 0;
    if (args.smooth) {
      add3<T>(sums + 3 * k, weights[k] * grad_mean);
      by_weight += load3(view.normals + 3 * p.corners[k]).dot(grad_mean);
    }
    if (position) {
      add3<T>(sums + 9 + 3 * k, weights[k] * grad_surface.point);
      by_weight += load3(view.vertices + 3 * p.corners[k]).dot(grad_surface.point);
    }
    if (grad_weights) grad_weights[k] = by_weight;
  }
}

// The light of each visible face of the block, or its normal. Weights do not matter.
template <class T>
void light_faces(const LitColors<T>& args, const View<T>& view, const Lights<T>& lights,
                 LitSums<T>& sums) {
  T* face = reserve(sums.faces, 3 * sums.visible.count);
  for (int64_t n = 1; n < sums.visible.count; ++n) {
    const Pixel<T> p = pixel_of<T>(args, view, sums.visible.ids[n], nullptr, false);
    const Vec3<T> light =
        args.parameters ? light_at(lights, p.surface, false).diffuse : p.surface.normal;
    for (int k = 0; k < 3; ++k) face[3 * n + k] = light[k];
  }
}

// Pixels [begin, end) if the light depends only on the face. kColors: channels of colours; 0 means
// white.
template <int64_t kColors, class T>
void lit_faces_forward(const LitColors<T>& args, int64_t begin, int64_t end,
                       const LitSums<T>& sums) {
  const int32_t *face_index = args.at.face_index, *slots = sums.visible.slots.data() + 1;
  const T *faces = sums.faces.data(), *colors = args.colors;
  T* lit = args.lit + 3 * begin;
  for (int64_t n = begin; n < end; ++n, lit += 3) {
    const bool drawn = face_index[n] >= 0;
    const T* face = faces + 3 * (drawn ? slots[face_index[n]] : 0);  // 0: any values
    T light[3];
    for (int k = 0; k < 3; ++k)
      light[k] = kColors ? colors[kColors * n + (kColors == 3 ? k : 0)] * face[k] : face[k];
    for (int k = 0; k < 3; ++k) lit[k] = drawn ? light[k] : T(0);
  }
}

// Gradients of lit_faces_forward: those of colours, and in sums.values, from entry 9 of each face
// on, of its light.
template <int64_t kColors, class T>
void lit_faces_backward(const LitColors<T>& args, int64_t begin, int64_t end, LitSums<T>& sums) {
  const int32_t *face_index = args.at.face_index, *slots = sums.visible.slots.data() + 1;
  const T *faces = sums.faces.data(), *grads = args.grad_lit, *colors = args.colors;
  T *grad_colors = kColors ? args.grad_colors : nullptr, *values = sums.values.data() + 9;
  if (args.at.grad_weights) std::fill_n(args.at.grad_weights + 3 * begin, 3 * (end - begin), T(0));
  if (grad_colors) std::fill_n(grad_colors + kColors * begin, kColors * (end - begin), T(0));
  for (int64_t n = begin; n < end; ++n) {
    if (face_index[n] < 0) continue;
    const int64_t slot = slots[face_index[n]];
    const T *grad = grads + 3 * n, *face = faces + 3 * slot;
    T* sum = values + kLitSums * slot;
    for (int k = 0; k < 3; ++k) {
      const int64_t at = kColors * n + (kColors == 3 ? k : 0);
      sum[k] += kColors ? colors[at] * grad[k] : grad[k];
      if (grad_colors) grad_colors[at] += face[k] * grad[k];
    }
  }
}

// Pixels of a block.
template <int64_t kColors, class T>
void lit_block_forward(const LitColors<T>& args, const RowBlock& block, LitSums<T>& sums) {
  const int64_t begin = block.begin(), end = block.end();
  const View<T> view(args, block.b);
  const Lights<T> lights = lights_of(args, block.b);
  const bool position = uses_position(args), per_face = !args.smooth && !position;
  if (per_face) {
    sums.visible.list(args.at.face_index + begin, end - begin, view.image.num_faces);
    light_faces(args, view, lights, sums);
    return lit_faces_forward<kColors>(args, begin, end, sums);
  }
  for (int64_t n = begin; n < end; ++n) {
    const int64_t id = args.at.face_index[n];
    T* lit = args.lit + 3 * n;
    if (id < 0) {
      for (int k = 0; k < 3; ++k) lit[k] = 0;
      continue;
    }
    const T* color = kColors ? args.colors + kColors * n : nullptr;
    const Pixel<T> p = pixel_of(args, view, id, args.at.weights + 3 * n, position);
    const PixelLight<T> reflected = args.parameters
                                        ? light_at(lights, p.surface, lights.highlights)
                                        : PixelLight<T>{p.surface.normal, Vec3<T>::Zero()};
    for (int k = 0; k < 3; ++k)
      lit[k] =
          (kColors ? color[kColors == 3 ? k : 0] * reflected.diffuse[k] : reflected.diffuse[k]) +
          reflected.highlight[k];
  }
}

template <int64_t kColors, class T>
void lit_block_backward(const LitColors<T>& args, const RowBlock& block, LitSums<T>& sums) {
  const int64_t begin = block.begin(), end = block.end();
  const View<T> view(args, block.b);
  const Lights<T> lights = lights_of(args, block.b);
  const bool position = uses_position(args), per_face = !args.smooth && !position;
  sums.lights = lights;
  sums.lights.set_zero();
  sums.start(args.at.face_index + begin, end - begin, view.image.num_faces, kLitSums);
  if (per_face) {
    light_faces(args, view, lights, sums);
    lit_faces_backward<kColors>(args, begin, end, sums);
  }
  for (int64_t n = begin; !per_face && n < end; ++n) {
    const int64_t id = args.at.face_index[n];
    T* grad_color = kColors && args.grad_colors ? args.grad_colors + kColors * n : nullptr;
    T* grad_weights = args.at.grad_weights ? args.at.grad_weights + 3 * n : nullptr;
    if (grad_weights) std::fill_n(grad_weights, 3, T(0));
    for (int64_t k = 0; grad_color && k < kColors; ++k) grad_color[k] = 0;
    if (id < 0) continue;
    const T *color = kColors ? args.colors + kColors * n : nullptr, *grad = args.grad_lit + 3 * n;
    T* sum = sums.of(id, kLitSums);
    const T* weights = args.at.weights + 3 * n;
    const Pixel<T> p = pixel_of(args, view, id, weights, position);
    PixelLight<T> grads{load3(grad), load3(grad)};
    for (int k = 0; kColors && k < 3; ++k) grads.diffuse[k] *= color[kColors == 3 ? k : 0];
    if (grad_color) {
      const Vec3<T> light =
          args.parameters ? light_at(lights, p.surface, false).diffuse : p.surface.normal;
      for (int k = 0; k < 3; ++k) grad_color[kColors == 3 ? k : 0] += light[k] * grad[k];
    }
    pixel_backward(args, view, lights, p, weights, grads, position, sums.lights, sum, grad_weights);
  }
  for (int64_t n = 1; per_face && n < sums.visible.count; ++n) {
    T* sum = sums.values.data() + kLitSums * n;
    const Pixel<T> p = pixel_of<T>(args, view, sums.visible.ids[n], nullptr, false);
    const PixelLight<T> grads{load3(sum + 9), Vec3<T>::Zero()};
    pixel_backward<T>(args, view, lights, p, nullptr, grads, false, sums.lights, sum, nullptr);
  }
}

// Adds the sums of a block to the gradients.
template <class T>
void scatter_lit(const LitColors<T>& args, int64_t b, LitSums<T>& sums) {
  const View<T> view(args, b);
  const bool position = uses_position(args);
  for (int64_t n = 1; n < sums.visible.count; ++n) {
    const int64_t face = face_of(sums.visible.ids[n], view.image.num_faces);
    const int64_t* corners = view.image.corners + 3 * face;
    const T* sum = sums.values.data() + kLitSums * n;
    if (args.grad_normals && !args.smooth)
      add3(args.grad_normals + 3 * (view.first_normal + face), load3(sum));
    for (int k = 0; k < 3; ++k) {
      if (args.grad_normals && args.smooth)
        add3(args.grad_normals + 3 * (view.first_normal + corners[k]), load3(sum + 3 * k));
      if (args.at.grad_attributes && position)
        add3(args.at.grad_attributes + 3 * (view.image.first_row + corners[k]),
             load3(sum + 9 + 3 * k));
    }
  }
  if (args.parameters && args.grad_parameters)
    for_parameters(args, b, sums.lights,
                   [&](int64_t n, T& value) { args.grad_parameters[n] += value; });
}

template <class T, class Body>
void with_colors(const LitColors<T>& args, const Body& body) {
  if (!args.colors) return body(std::integral_constant<int64_t, 0>());
  if (args.channels == 1) return body(std::integral_constant<int64_t, 1>());
  body(std::integral_constant<int64_t, 3>());
}

}  // namespace

template <class T>
void lit_forward(const LitColors<T>& args) {
  for_blocks(args.at.batch, args.at.raster, args.at.num_threads, args.at.face_rows,
             [&](const RowBlock& block) {
               with_colors(args, [&](auto known) {
                 lit_block_forward<known()>(args, block, thread_scratch<LitSums<T>>());
               });
             });
}

// Parameters, normals and vertices are summed in the order of images and blocks.
template <class T>
void lit_backward(const LitColors<T>& args) {
  const int64_t normals = args.normal_rows.total(args.at.batch),
                vertices = args.at.rows.total(args.at.batch);
  if (args.grad_normals) std::fill_n(args.grad_normals, 3 * normals, T(0));
  if (args.at.grad_attributes) std::fill_n(args.at.grad_attributes, 3 * vertices, T(0));
  if (args.grad_parameters) std::fill_n(args.grad_parameters, args.num_parameters, T(0));
  sum_blocks<LitSums<T>>(
      args.at.batch, args.at.raster, true, args.at.num_threads, args.at.face_rows,
      [&](const RowBlock& block, LitSums<T>& sums) {
        with_colors(args, [&](auto known) { lit_block_backward<known()>(args, block, sums); });
      },
      [&](int64_t b, LitSums<T>& sums) { scatter_lit(args, b, sums); });
}

NMR_FLOAT_AND_DOUBLE(lit_forward, LitColors)
NMR_FLOAT_AND_DOUBLE(lit_backward, LitColors)

}  // namespace nmr
