// Normal equations of the photometric error of one view: by its pose and by the landmarks at its pixels.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <unordered_map>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "../geometry/camera.hpp"
#include "bindings.hpp"
#include "landmarks.hpp"

namespace spiked {
namespace {

using Image = Array<const float, 2>;

constexpr int kCoordinateBits = 18;

// The cube of space that a point lies in. Cubes are about equally large in the image at any depth: their side doubles
// from each octave of depth to the next.
int64_t landmark_key(const double* point, double depth, double width_rad) {
    const int octave = std::ilogb(depth * M_SQRT2);
    const double side = std::ldexp(width_rad, octave);
    int64_t key = octave & 0xff;
    for (int i = 0; i < 3; ++i) {
        const auto at = static_cast<int64_t>(std::floor(point[i] / side));
        key = (key << kCoordinateBits) | (at & ((1 << kCoordinateBits) - 1));
    }
    return key;
}

SPIKED_CLONES void add_row(const double* row, double weight, double* landmark, double* pose) {
    for (int i = 0; i < kLandmark; ++i)
        for (int j = 0; j < kRow; ++j) landmark[kRow * i + j] += weight * row[i] * row[j];
    for (int i = 0; i < kPose; ++i)
        for (int j = 0; j <= kPose; ++j) pose[(kPose + 1) * i + j] += weight * row[kLandmark + i] * row[kLandmark + j];
}

size_t photometric_normals(const Image& error, const Image& du, const Image& dv, const Image& depth,
                           const Image& weight, double fx, double fy, double cx, double cy,
                           const Array<const double, 2>& rotation, const Array<const double, 1>& centre,
                           double width_rad, const Array<double, 2>& pose, const Array<int64_t, 1>& keys,
                           const Array<double, 3>& landmarks, const std::optional<Array<const double, 1>>& given) {
    const size_t height = error.shape(0), width = error.shape(1), room = keys.shape(0);
    for (const Image* one : {&du, &dv, &depth, &weight}) {
        if (one->shape(0) != height || one->shape(1) != width) throw std::invalid_argument("images must be alike");
    }
    if (rotation.shape(0) != 3 || rotation.shape(1) != 3 || centre.shape(0) != 3 || pose.shape(0) != kPose ||
        pose.shape(1) != kPose + 1 || landmarks.shape(0) != room || landmarks.shape(1) != kLandmark ||
        landmarks.shape(2) != kRow || !(width_rad > 0)) {
        throw std::invalid_argument(
            "expected rotation [3, 3], centre [3], width_rad above 0, pose [6, 7], keys [N], landmarks [N, 3, 10]");
    }
    const Lens lens = lens_of(given);
    const double* r = rotation.data();
    std::unordered_map<int64_t, size_t> known;
    int64_t last = 0;  // neighbours mostly see the same landmark
    double* landmark = nullptr;
    std::fill_n(pose.data(), kPose * (kPose + 1), 0.0);
    for (size_t v = 0, n = 0; v < height; ++v) {
        for (size_t u = 0; u < width; ++u, ++n) {
            const double w = weight.data()[n], z = depth.data()[n];
            if (!(w > 0) || !(z > kNearest)) continue;
            double x = (u + 0.5 - cx) / fx * z, y = (v + 0.5 - cy) / fy * z;
            // The point carries its colour, so the image at a fixed pixel changes by minus the slope times its motion.
            double a = -du.data()[n] * fx / z, b = -dv.data()[n] * fy / z;
            if (lens.model) {
                x = (u + 0.5 - cx) / fx, y = (v + 0.5 - cy) / fy;
                straighten(lens, x, y);
                const Bent bent = bend(lens, x, y);
                const double along = a;
                a = bent.xx * along + bent.xy * b, b = bent.xy * along + bent.yy * b;
                x *= z, y *= z;
            }
            const double slope[3] = {a, b, -(a * x + b * y) / z}, local[3] = {x, y, z};
            double row[kRow], ray[3], point[3];
            to_world(r, slope, row);
            to_world(r, local, ray);
            for (int i = 0; i < 3; ++i) point[i] = centre.data()[i] + ray[i];
            by_pose(row, ray, row + kLandmark);
            row[kLandmark + kPose] = error.data()[n];
            const int64_t key = landmark_key(point, z, width_rad);
            if (!landmark || key != last) {
                const auto [found, fresh] = known.try_emplace(key, known.size());
                if (found->second >= room) throw std::invalid_argument("there are more landmarks than room for them");
                landmark = landmarks.data() + found->second * kLandmark * kRow;
                if (fresh) {
                    keys.data()[found->second] = key;
                    std::fill_n(landmark, kLandmark * kRow, 0.0);
                }
                last = key;
            }
            add_row(row, w, landmark, pose.data());
        }
    }
    return known.size();
}

}  // namespace

void bind_photometric(nb::module_& m) {
    m.def("photometric_normals", &photometric_normals, nb::arg("error"), nb::arg("du"), nb::arg("dv"), nb::arg("depth"),
          nb::arg("weight"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"), nb::arg("rotation"),
          nb::arg("centre"), nb::arg("width_rad"), nb::arg("pose").noconvert(), nb::arg("keys").noconvert(),
          nb::arg("landmarks").noconvert(), nb::arg("lens") = nb::none(),
          "Sums over the pixels of a view with `weight` above 0, for `error` = map - view, its slopes `du`, `dv` and "
          "`depth` [h, w].\n"
          "`pose` [6, 7] gets the Hessian by (rotation vector on the left, centre) and the gradient. Pixels that see "
          "the same\n"
          "cube of space, about `width_rad` wide in angle, share one landmark. For each, `keys` names it and "
          "`landmarks` [N, 3, 10]\n"
          "gets the Hessian by landmark (3), by landmark and pose (6), and the gradient. Returns the number of "
          "landmarks.");
}

}  // namespace spiked
