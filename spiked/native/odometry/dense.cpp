// What all strong pixels of one view say of its pose and of the places that they see.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <unordered_map>

#include "../clones.hpp"
#include "arrays.hpp"
#include "camera.hpp"

namespace spiked {
namespace {

using Image = Array<const float, 2>;

constexpr int kPlace = 3, kPose = 6;
constexpr int kRow = kPlace + kPose + 1;  // derivatives by place and by pose, and the error
constexpr int kCoordinateBits = 18;

// Cubes in space that are about as large in the image whatever their depth: they double from each octave to the next.
int64_t place_of(const double* point, double depth, double width_rad) {
    const int octave = std::ilogb(depth * M_SQRT2);
    const double side = std::ldexp(width_rad, octave);
    int64_t key = octave & 0xff;
    for (int i = 0; i < 3; ++i) {
        const auto at = static_cast<int64_t>(std::floor(point[i] / side));
        key = (key << kCoordinateBits) | (at & ((1 << kCoordinateBits) - 1));
    }
    return key;
}

SPIKED_CLONES void add_row(const double* row, double weight, double* place, double* pose) {
    for (int i = 0; i < kPlace; ++i)
        for (int j = 0; j < kRow; ++j) place[kRow * i + j] += weight * row[i] * row[j];
    for (int i = 0; i < kPose; ++i)
        for (int j = 0; j <= kPose; ++j) pose[(kPose + 1) * i + j] += weight * row[kPlace + i] * row[kPlace + j];
}

size_t sum_pixels(const Image& error, const Image& du, const Image& dv, const Image& depth, const Image& weight,
                  double fx, double fy, double cx, double cy, const Array<const double, 2>& rotation,
                  const Array<const double, 1>& centre, double width_rad, const Array<double, 2>& pose,
                  const Array<int64_t, 1>& keys, const Array<double, 3>& places) {
    const size_t height = error.shape(0), width = error.shape(1), room = keys.shape(0);
    for (const Image* one : {&du, &dv, &depth, &weight}) {
        if (one->shape(0) != height || one->shape(1) != width) throw std::invalid_argument("images must be alike");
    }
    if (rotation.shape(0) != 3 || rotation.shape(1) != 3 || centre.shape(0) != 3 || pose.shape(0) != kPose ||
        pose.shape(1) != kPose + 1 || places.shape(0) != room || places.shape(1) != kPlace || places.shape(2) != kRow ||
        !(width_rad > 0)) {
        throw std::invalid_argument(
            "expected rotation [3, 3], centre [3], width_rad above 0, pose [6, 7], keys [N], places [N, 3, 10]");
    }
    const double* r = rotation.data();
    std::unordered_map<int64_t, size_t> known;
    int64_t last = 0;  // neighbours mostly see the same place
    double* place = nullptr;
    std::fill_n(pose.data(), kPose * (kPose + 1), 0.0);
    for (size_t v = 0, n = 0; v < height; ++v) {
        for (size_t u = 0; u < width; ++u, ++n) {
            const double w = weight.data()[n], z = depth.data()[n];
            if (!(w > 0) || !(z > kNearest)) continue;
            const double x = (u + 0.5 - cx) / fx * z, y = (v + 0.5 - cy) / fy * z;
            // Where the map's point moves to, its colour goes: at a fixed pixel one sees what lay the other way.
            const double a = -du.data()[n] * fx / z, b = -dv.data()[n] * fy / z;
            const double slope[3] = {a, b, -(a * x + b * y) / z}, local[3] = {x, y, z};
            double row[kRow], ray[3], point[3];
            to_world(r, slope, row);
            to_world(r, local, ray);
            for (int i = 0; i < 3; ++i) point[i] = centre.data()[i] + ray[i];
            by_pose(row, ray, row + kPlace);
            row[kPlace + kPose] = error.data()[n];
            const int64_t key = place_of(point, z, width_rad);
            if (!place || key != last) {
                const auto [found, fresh] = known.try_emplace(key, known.size());
                if (found->second >= room) throw std::invalid_argument("there are more places than room for them");
                place = places.data() + found->second * kPlace * kRow;
                if (fresh) {
                    keys.data()[found->second] = key;
                    std::fill_n(place, kPlace * kRow, 0.0);
                }
                last = key;
            }
            add_row(row, w, place, pose.data());
        }
    }
    return known.size();
}

}  // namespace

void bind_dense(nb::module_& m) {
    m.def("sum_pixels", &sum_pixels,
          "Sums over the pixels of a view with `weight` above 0, for `error` = map - view, its slopes `du`, `dv` and "
          "`depth` [h, w]:\n"
          "`pose` [6, 7] holds the Hessian by (rotation vector on the left, centre) and the gradient. Pixels that see "
          "the same\n"
          "cube of space, about `width_rad` wide from where they are seen, see one place that may move: for each, "
          "`keys` names it and\n"
          "`places` [N, 3, 10] holds the Hessian by place (3) and by place and pose (6), and the gradient. Returns how "
          "many places.");
}

}  // namespace spiked
