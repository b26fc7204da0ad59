// The pose of one view from known points: robust Gauss-Newton.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "../common/arrays.hpp"
#include "../geometry/camera.hpp"
#include "../geometry/so3.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr double kConverged = 1e-7;   // rad, and units of the typical depth: the search ends at a smaller step
constexpr double kBehindError = 1e3;  // px, the error of a point that is not in front of the camera

// Solves the symmetric positive definite 6x6 system a x = b in place (Cholesky); false where it is not definite.
bool solve6(double* a, double* b) {
    for (int j = 0; j < 6; ++j) {
        double pivot = a[6 * j + j];
        for (int k = 0; k < j; ++k) pivot -= a[6 * j + k] * a[6 * j + k];
        if (!(pivot > 0)) return false;
        pivot = std::sqrt(pivot);
        a[6 * j + j] = pivot;
        for (int i = j + 1; i < 6; ++i) {
            double sum = a[6 * i + j];
            for (int k = 0; k < j; ++k) sum -= a[6 * i + k] * a[6 * j + k];
            a[6 * i + j] = sum / pivot;
        }
    }
    for (int i = 0; i < 6; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= a[6 * i + k] * b[k];
        b[i] /= a[6 * i + i];
    }
    for (int i = 5; i >= 0; --i) {
        for (int k = i + 1; k < 6; ++k) b[i] -= a[6 * k + i] * b[k];
        b[i] /= a[6 * i + i];
    }
    return true;
}

// rotation <- Exp(phi) rotation.
void rotate_left(const double* phi, double* rotation) {
    double e[9], out[9];
    exponential(phi, e);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out[3 * i + j] = e[3 * i] * rotation[j] + e[3 * i + 1] * rotation[3 + j] + e[3 * i + 2] * rotation[6 + j];
    std::copy_n(out, 9, rotation);
}

void fit_pose(const Array<const double, 2>& points, const Array<const double, 2>& pixels, double fx, double fy,
              double cx, double cy, const Array<const double, 1>& scales, const Array<double, 2>& rotation,
              const Array<double, 1>& centre, const Array<double, 1>& error, const Array<double, 2>& hessian, bool move,
              const std::optional<Array<const double, 1>>& lens) {
    const size_t count = points.shape(0);
    if (points.shape(1) != 3 || pixels.shape(0) != count || pixels.shape(1) != 2 || error.shape(0) != count ||
        rotation.shape(0) != 3 || rotation.shape(1) != 3 || centre.shape(0) != 3 || hessian.shape(0) != 6 ||
        hessian.shape(1) != 6) {
        throw std::invalid_argument(
            "expected points [n, 3], pixels [n, 2], rotation [3, 3], centre [3], error [n], hessian [6, 6]");
    }
    const Pinhole k = {fx, fy, cx, cy, lens_of(lens)};
    const Pose pose = {rotation.data(), centre.data()};
    for (size_t round = 0; round < scales.shape(0); ++round) {
        const double scale = scales.data()[round];
        double h[36] = {}, g[6] = {};
        for (size_t n = 0; n < count; ++n) {
            Projection projection = project(k, pose, points.data() + 3 * n, pixels.data() + 2 * n);
            if (!projection.in_front) projection.error[0] = projection.error[1] = kBehindError;
            const double square = projection.error[0] * projection.error[0] + projection.error[1] * projection.error[1];
            error.data()[n] = std::sqrt(square);
            const double weight = 1 / (1 + square / (scale * scale));
            for (int row = 0; row < 2; ++row) {
                double a[6];
                by_pose(projection.by_point[row], projection.ray, a);
                for (int i = 0; i < 6; ++i) {
                    const double wa = weight * a[i];
                    for (int j = 0; j <= i; ++j) h[6 * i + j] += wa * a[j];
                    g[i] -= wa * projection.error[row];
                }
            }
        }
        double trace = 0;
        for (int i = 0; i < 6; ++i) {
            trace += h[7 * i];
            for (int j = i + 1; j < 6; ++j) h[6 * i + j] = h[6 * j + i];
        }
        for (int i = 0; i < 6; ++i) h[7 * i] += 1e-9 * trace;
        std::copy_n(h, 36, hessian.data());
        if (!move || !solve6(h, g)) break;
        rotate_left(g, rotation.data());
        double most = 0;
        for (int i = 0; i < 3; ++i) centre.data()[i] += g[3 + i];
        for (const double part : g) most = std::max(most, std::abs(part));
        if (most < kConverged && scale == scales.data()[scales.shape(0) - 1]) break;
    }
}

// Root mean square motion (px, one direction) of the image of a plane at `depth`, at 5x5 places, under errors of a pose
// with the inverse of this Hessian as covariance.
double displacement(const Array<const double, 2>& hessian, const Array<const double, 2>& rotation, double fx, double fy,
                    double cx, double cy, double depth) {
    if (hessian.shape(0) != 6 || hessian.shape(1) != 6 || rotation.shape(0) != 3 || rotation.shape(1) != 3) {
        throw std::invalid_argument("expected hessian [6, 6], rotation [3, 3]");
    }
    constexpr int kSteps = 5;
    const double* r = rotation.data();
    double sum = 0;
    for (int n = 0; n < 2 * kSteps * kSteps; ++n) {
        const double across = (n / 2 % kSteps) * 2.0 / (kSteps - 1) - 1,
                     down = (n / 2 / kSteps) * 2.0 / (kSteps - 1) - 1;
        const double x = across * cx / fx, y = down * cy / fy;
        const double slope[3] = {(n % 2 ? 0 : fx) / depth, (n % 2 ? fy : 0) / depth,
                                 (n % 2 ? -fy * y : -fx * x) / depth};
        const double local[3] = {depth * x, depth * y, depth};
        double by_point[3], ray[3], row[6], solved[6], h[36];
        to_world(r, slope, by_point);
        to_world(r, local, ray);
        by_pose(by_point, ray, row);
        std::copy_n(row, 6, solved);
        std::copy_n(hessian.data(), 36, h);
        if (!solve6(h, solved)) return std::numeric_limits<double>::infinity();
        for (int i = 0; i < 6; ++i) sum += row[i] * solved[i];
    }
    return std::sqrt(sum / (2 * kSteps * kSteps));
}

}  // namespace

void bind_pose(nb::module_& m) {
    m.def("fit_pose", &fit_pose, nb::arg("points"), nb::arg("pixels"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"),
          nb::arg("cy"), nb::arg("scales"), nb::arg("rotation").noconvert(), nb::arg("centre").noconvert(),
          nb::arg("error").noconvert(), nb::arg("hessian").noconvert(), nb::arg("move"), nb::arg("lens") = nb::none(),
          "Gauss-Newton with Cauchy weights, a step for each of `scales` (px) until they are small at the last: "
          "changes rotation and centre in place;\n"
          "`error` [n] (px) and `hessian` [6, 6] are those before the last step. Without `move` the pose is not "
          "changed.");
    m.def("displacement", &displacement,
          "Root mean square motion (px, one direction) of a plane at `depth` for a pose with this Hessian.");
}

}  // namespace spiked
