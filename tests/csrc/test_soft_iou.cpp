// Soft intersection over union of pairs of images.
#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
struct Overlap {
  std::vector<double> areas;
  std::vector<T> iou;
};

template <class T>
Overlap<T> overlap_of(const std::vector<T>& prediction, const std::vector<T>& target, int64_t batch, int num_threads) {
  Overlap<T> r{unwritten<double>(2 * batch), unwritten<T>(batch)};
  const auto count = static_cast<int64_t>(prediction.size()) / batch;
  soft_iou_forward(SoftIou<T>{prediction.data(), target.data(), batch, count, r.areas.data(), r.iou.data(), nullptr, nullptr, nullptr,
                              num_threads});
  return r;
}

// Values in [0, 1).
template <class T>
std::vector<T> image(int seed, int64_t size) {
  std::vector<T> values = noise_array<T>(seed, size);
  for (T& value : values) value = std::abs(value) - std::floor(std::abs(value));
  return values;
}

}  // namespace

TEST_REAL(soft_iou_of_a_known_pair) {
  const std::vector<T> prediction{0.5, 1, 0, 0, 0, 0}, target{0, 1, 1, 0, 0, 0};
  const Overlap<T> r = overlap_of(prediction, target, 2, 1);
  CHECK_NEAR(r.iou[0], 0.4, 1e-6);
  CHECK_EQUAL(r.iou[1], T(1));  // two empty images
  CHECK_EQUAL(r.areas[0], 1.0);
  CHECK_EQUAL(r.areas[1], 2.5);
}

// 4099 values: a whole chunk and a vector that is not full.
TEST(soft_iou_gradient_is_the_derivative) {
  const int64_t batch = 2, count = 4099;
  const std::vector<double> prediction = image<double>(1, batch * count), target = image<double>(2, batch * count);
  const std::vector<double> grad_iou{0.7, -1.3};
  Overlap<double> r = overlap_of(prediction, target, batch, 1);
  std::vector<double> grad = unwritten<double>(batch * count), grad_target = unwritten<double>(batch * count);
  soft_iou_backward(SoftIou<double>{prediction.data(), target.data(), batch, count, r.areas.data(), nullptr, grad_iou.data(), grad.data(),
                                    grad_target.data(), 2});
  for (int64_t n : {int64_t(0), int64_t(17), int64_t(4095), int64_t(4096), int64_t(4098)}) {
    for (int64_t b = 0; b < batch; ++b) {
      for (const bool second : {false, true}) {
        double iou[2];
        for (int side = 0; side < 2; ++side) {
          std::vector<double> p = prediction, t = target;
          (second ? t : p)[b * count + n] += side ? 1e-3 : -1e-3;
          iou[side] = overlap_of(p, t, batch, 1).iou[b];
        }
        CHECK_NEAR((second ? grad_target : grad)[b * count + n], grad_iou[b] * (iou[1] - iou[0]) / 2e-3, 1e-9);
      }
    }
  }
}

TEST_REAL(soft_iou_depends_neither_on_threads_nor_on_the_batch) {
  const int64_t batch = 5, count = 4099;
  const std::vector<T> prediction = image<T>(3, batch * count), target = image<T>(4, batch * count);
  const Overlap<T> one = overlap_of(prediction, target, batch, 1), three = overlap_of(prediction, target, batch, 3);
  for (int64_t b = 0; b < batch; ++b) {
    const auto row = [&](const std::vector<T>& all) {
      return std::vector<T>(all.begin() + b * count, all.begin() + (b + 1) * count);
    };
    CHECK_EQUAL(one.iou[b], three.iou[b]);
    CHECK_EQUAL(one.iou[b], overlap_of(row(prediction), row(target), 1, 1).iou[0]);
  }
}

}  // namespace nmr::test
