// Normal equations of poses and points with Cauchy weights; the points are eliminated (Schur complement).
// (B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.)
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "../geometry/camera.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

using In2 = Array<const double, 2>;
using In3 = Array<const double, 3>;
using Index = Array<const int64_t, 1>;
using Index2 = Array<const int64_t, 2>;

constexpr double kMaxSquare = 1e6;  // limit of a squared error, in units of the scale
constexpr double kProductLimit =
    1e290;                          // one logarithm is taken of a product of many factors; above this it could overflow
constexpr double kDiagonal = 1e-9;  // added to the diagonal of a point's Hessian

// Observations of points by cameras. The constructor checks all indices.
struct Observations {
    Observations(const In3& rotations, const In2& centres, const In2& points, const Index& camera, const Index& point,
                 const In2& pixels)
        : rotations(rotations.data()),
          centres(centres.data()),
          points(points.data()),
          pixels(pixels.data()),
          camera(camera.data()),
          point(point.data()),
          cameras(static_cast<int64_t>(centres.shape(0))),
          point_count(static_cast<int64_t>(points.shape(0))),
          count(static_cast<int64_t>(camera.shape(0))) {
        if (rotations.shape(0) != centres.shape(0) || rotations.shape(1) != 3 || rotations.shape(2) != 3 ||
            centres.shape(1) != 3 || points.shape(1) != 3 || pixels.shape(1) != 2) {
            throw std::invalid_argument("expected rotations [C, 3, 3], centres [C, 3], points [P, 3], pixels [M, 2]");
        }
        if (point.shape(0) != camera.shape(0) || pixels.shape(0) != camera.shape(0)) {
            throw std::invalid_argument("camera, point and pixels must have one entry for each observation");
        }
        for (int64_t m = 0; m < count; ++m) {
            if (this->camera[m] < 0 || this->camera[m] >= cameras || this->point[m] < 0 ||
                this->point[m] >= point_count) {
                throw std::invalid_argument("an observation names a camera or point that does not exist");
            }
        }
    }

    template <bool Bent>
    Projection project_by(const Pinhole& k, int64_t m) const {
        return spiked::project_by<Bent>(k, {rotations + 9 * camera[m], centres + 3 * camera[m]}, points + 3 * point[m],
                                        pixels + 2 * m);
    }

    Projection project(const Pinhole& k, int64_t m) const {
        return k.lens.model ? project_by<true>(k, m) : project_by<false>(k, m);
    }

    // Observation numbers by point: those of p are order[first[p]] to order[first[p + 1] - 1].
    void by_point(std::vector<int64_t>& first, std::vector<int64_t>& order) const {
        first.assign(point_count + 1, 0);
        order.resize(count);
        for (int64_t m = 0; m < count; ++m) ++first[point[m] + 1];
        for (int64_t p = 0; p < point_count; ++p) first[p + 1] += first[p];
        std::vector<int64_t> next(first.begin(), first.end() - 1);
        for (int64_t m = 0; m < count; ++m) order[next[point[m]]++] = m;
    }

    const double *rotations, *centres, *points, *pixels;
    const int64_t *camera, *point;
    int64_t cameras, point_count, count;
};

double cauchy_square(const Projection& projection, double scale) {
    if (!projection.in_front) return 2 * kMaxSquare;
    const double u = projection.error[0] / scale, v = projection.error[1] / scale;
    return std::min(u * u, kMaxSquare) + std::min(v * v, kMaxSquare);
}

void residuals(const In3& rotations, const In2& centres, const In2& points, const Index& camera, const Index& point,
               const In2& pixels, double fx, double fy, double cx, double cy, const Array<double, 2>& out,
               const std::optional<Array<const double, 1>>& lens) {
    const Observations observations(rotations, centres, points, camera, point, pixels);
    if (out.shape(0) != camera.shape(0) || out.shape(1) != 2) throw std::invalid_argument("out must be [M, 2]");
    const Pinhole k = {fx, fy, cx, cy, lens_of(lens)};
    for (int64_t m = 0; m < observations.count; ++m) {
        const Projection projection = observations.project(k, m);
        for (int i = 0; i < 2; ++i) {
            out.data()[2 * m + i] = projection.in_front ? projection.error[i] : std::numeric_limits<double>::infinity();
        }
    }
}

double cost(const In3& rotations, const In2& centres, const In2& points, const Index& camera, const Index& point,
            const In2& pixels, double fx, double fy, double cx, double cy, double scale,
            const std::optional<Array<const double, 1>>& lens) {
    const Observations observations(rotations, centres, points, camera, point, pixels);
    const Pinhole k = {fx, fy, cx, cy, lens_of(lens)};
    double sum = 0, product = 1;
    for (int64_t m = 0; m < observations.count; ++m) {
        product *= 1 + cauchy_square(observations.project(k, m), scale);
        if (product < kProductLimit) continue;
        sum += std::log(product);
        product = 1;
    }
    return (sum + std::log(product)) / static_cast<double>(observations.count);
}

// The inverse of the lower Cholesky factor of a symmetric 3x3 matrix, row-major; its upper part is zero.
void inverse_cholesky(const double* v, double* out) {
    const double a = std::sqrt(v[0]), b = v[3] / a, c = v[6] / a;
    const double d = std::sqrt(std::max(v[4] - b * b, kDiagonal)), e = (v[7] - b * c) / d;
    const double f = std::sqrt(std::max(v[8] - c * c - e * e, kDiagonal));
    out[0] = 1 / a;
    out[1] = out[2] = out[5] = 0;
    out[3] = -b / (a * d);
    out[4] = 1 / d;
    out[6] = (b * e - c * d) / (a * d * f);
    out[7] = -e / (d * f);
    out[8] = 1 / f;
}

// Six parameters of a pose, padded to a whole vector.
constexpr int kPoseStride = 8;

// The optics that may be free, in this order: the logarithm of the focal length, and k1 with k2 of the lens, OpenCV's
// if there is none.
constexpr int kMostOptics = 3;

struct System {
    double scale, damping;
    int64_t size, unknown, each;  // D, D without the optics, slots of a pose
    const int64_t* slots;
    const double* shares;
    double *hessian, *gradient, *eliminated, *whitened_gradient, *roots;
    bool focal, radial;

    int optics() const { return focal + 2 * radial; }
};

// Sums over the observations of each pose, in rows of kPoseStride.
struct PoseSums {
    explicit PoseSums(int64_t cameras)
        : hessian(6 * kPoseStride * cameras),
          gradient(kPoseStride * cameras),
          optics(kMostOptics * kPoseStride * cameras) {}

    std::vector<double> hessian, gradient, optics;
};

// Sums over all observations of a point.
struct PointSums {
    double hessian[9] = {}, gradient[3] = {}, optics[kMostOptics][3] = {};
};

// Derivatives of the two rows of an observation by the free optics.
SPIKED_INLINE void by_optics(const System& system, const Pinhole& k, const double* rotation,
                             const Projection& projection, const double* pixel, double out[2][kMostOptics]) {
    if (system.focal) {
        out[0][0] = projection.error[0] + pixel[0] - k.cx;
        out[1][0] = projection.error[1] + pixel[1] - k.cy;
    }
    if (!system.radial) return;
    double local[3] = {};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) local[j] += rotation[3 * i + j] * projection.ray[i];
    }
    double x = local[0] / local[2], y = local[1] / local[2], square = x * x + y * y;
    if (k.lens.model && square > k.lens.reach2) {
        const double shorter = std::sqrt(k.lens.reach2 / square);
        x *= shorter, y *= shorter, square = k.lens.reach2;
    }
    double first = square, next = square;  // of k1, and what makes that of k2 of it
    if (k.lens.model == 2) {
        const double r = std::sqrt(std::max(square, 1e-10)), angle = std::atan(r);
        first = angle * angle * angle / r;
        next = angle * angle;
    }
    const int k1 = system.focal, k2 = k1 + 1;
    out[0][k1] = k.fx * x * first;
    out[1][k1] = k.fy * y * first;
    out[0][k2] = out[0][k1] * next;
    out[1][k2] = out[1][k1] * next;
}

// Adds one row of an observation, with its derivatives `d` by the free optics.
SPIKED_INLINE void add_optics(const Projection& projection, int row, double weight, const double* d,
                              const System& system, double* own, PointSums& sums) {
    const int optics = system.optics();
    if (!optics) return;
    double a[6];
    by_pose(projection.by_point[row], projection.ray, a);
    for (int n = 0; n < optics; ++n) {
        for (int m = 0; m < optics; ++m) {
            system.hessian[(system.unknown + n) * system.size + system.unknown + m] += weight * d[n] * d[m];
        }
        system.gradient[system.unknown + n] += weight * d[n] * projection.error[row];
        for (int i = 0; i < 3; ++i) sums.optics[n][i] += weight * d[n] * projection.by_point[row][i];
        for (int i = 0; i < 6; ++i) own[kPoseStride * n + i] += weight * d[n] * a[i];
    }
}

// Adds one row (u or v) of an observation; `cross` [3][kPoseStride] is its block of point and pose.
SPIKED_INLINE void add_row(const Projection& projection, int row, double weight, double* own, double* own_gradient,
                           double* cross, PointSums& sums) {
    const double* b = projection.by_point[row];
    double a[kPoseStride] = {};
    by_pose(b, projection.ray, a);
    const double error = weight * projection.error[row];
    for (int i = 0; i < 3; ++i) {
        const double wb = weight * b[i];
        for (int j = 0; j < 3; ++j) sums.hessian[3 * i + j] += wb * b[j];
        sums.gradient[i] += b[i] * error;
        for (int j = 0; j < kPoseStride; ++j) cross[kPoseStride * i + j] += wb * a[j];
    }
    for (int i = 0; i < 6; ++i) {
        const double wa = weight * a[i];
        for (int j = 0; j < kPoseStride; ++j) own[kPoseStride * i + j] += wa * a[j];
    }
    for (int j = 0; j < kPoseStride; ++j) own_gradient[j] += a[j] * error;
}

// Eliminates a point: writes its root, its whitened gradient and its rows of `eliminated`.
SPIKED_INLINE void eliminate(const System& system, int64_t p, PointSums& sums, const std::vector<int64_t>& used,
                             double* cross) {
    for (int i = 0; i < 3; ++i) sums.hessian[4 * i] = sums.hessian[4 * i] * (1 + system.damping) + kDiagonal;
    double* root = system.roots + 9 * p;
    inverse_cholesky(sums.hessian, root);
    for (int a = 0; a < 3; ++a) {
        const double *r = root + 3 * a, *g = sums.gradient;
        double* to = system.eliminated + (3 * p + a) * system.size;
        system.whitened_gradient[3 * p + a] = r[0] * g[0] + r[1] * g[1] + r[2] * g[2];
        for (int n = 0; n < system.optics(); ++n) {
            const double* f = sums.optics[n];
            to[system.unknown + n] = r[0] * f[0] + r[1] * f[1] + r[2] * f[2];
        }
        for (const int64_t slot : used) {
            const double* from = cross + 3 * kPoseStride * slot;
            for (int i = 0; i < 6; ++i) {
                to[6 * slot + i] = r[0] * from[i] + r[1] * from[kPoseStride + i] + r[2] * from[2 * kPoseStride + i];
            }
        }
    }
    for (const int64_t slot : used) std::fill_n(cross + 3 * kPoseStride * slot, 3 * kPoseStride, 0.0);
}

template <bool Bent>
[[gnu::always_inline]] inline void add_landmarks_by(const Observations& observations, const Pinhole& k,
                                                    const System& system, PoseSums& poses) {
    std::vector<double> cross(3 * kPoseStride * (system.unknown / 6 + 1));
    std::vector<char> touched(system.unknown / 6 + 1);
    std::vector<int64_t> used, first, order;
    observations.by_point(first, order);
    for (int64_t p = 0; p < observations.point_count; ++p) {
        PointSums sums;
        used.clear();
        for (int64_t n = first[p]; n < first[p + 1]; ++n) {
            const int64_t m = order[n], c = observations.camera[m];
            const Projection projection = observations.project_by<Bent>(k, m);
            if (!projection.in_front) continue;
            const double weight = 1 / (1 + cauchy_square(projection, system.scale));
            double block[3 * kPoseStride] = {};
            double optics[2][kMostOptics];
            by_optics(system, k, observations.rotations + 9 * c, projection, observations.pixels + 2 * m, optics);
            for (int row = 0; row < 2; ++row) {
                add_row(projection, row, weight, poses.hessian.data() + 6 * kPoseStride * c,
                        poses.gradient.data() + kPoseStride * c, block, sums);
                add_optics(projection, row, weight, optics[row], system,
                           poses.optics.data() + kMostOptics * kPoseStride * c, sums);
            }
            for (int64_t s = c * system.each; s < (c + 1) * system.each; ++s) {
                const int64_t slot = system.slots[s];
                const double share = system.shares[s];
                if (slot < 0 || share == 0) continue;
                if (!touched[slot]) used.push_back(slot);
                touched[slot] = 1;
                double* into = cross.data() + 3 * kPoseStride * slot;
                for (int i = 0; i < 3 * kPoseStride; ++i) into[i] += share * block[i];
            }
        }
        for (const int64_t slot : used) touched[slot] = 0;
        eliminate(system, p, sums, used, cross.data());
    }
}

SPIKED_CLONES void add_landmarks(const Observations& observations, const Pinhole& k, const System& system,
                                 PoseSums& poses) {
    add_landmarks_by<false>(observations, k, system, poses);
}

SPIKED_CLONES void add_bent_landmarks(const Observations& observations, const Pinhole& k, const System& system,
                                      PoseSums& poses) {
    add_landmarks_by<true>(observations, k, system, poses);
}

// Adds the poses' sums to the slots that they are made of.
void scatter_to_slots(const System& system, int64_t cameras, const PoseSums& poses) {
    for (int64_t c = 0; c < cameras; ++c) {
        for (int64_t s = c * system.each; s < (c + 1) * system.each; ++s) {
            const int64_t slot = system.slots[s];
            const double share = system.shares[s];
            if (slot < 0 || share == 0) continue;
            for (int i = 0; i < 6; ++i) {
                double* row = system.hessian + (6 * slot + i) * system.size;
                system.gradient[6 * slot + i] += share * poses.gradient[kPoseStride * c + i];
                for (int64_t t = c * system.each; t < (c + 1) * system.each; ++t) {
                    const int64_t other = system.slots[t];
                    if (other < 0 || system.shares[t] == 0) continue;
                    const double* own = poses.hessian.data() + (6 * c + i) * kPoseStride;
                    for (int j = 0; j < 6; ++j) row[6 * other + j] += share * system.shares[t] * own[j];
                }
                for (int n = 0; n < system.optics(); ++n) {
                    const double value = share * poses.optics[(kMostOptics * c + n) * kPoseStride + i];
                    row[system.unknown + n] += value;
                    system.hessian[(system.unknown + n) * system.size + 6 * slot + i] += value;
                }
            }
        }
    }
}

void linearise(const In3& rotations, const In2& centres, const In2& points, const Index& camera, const Index& point,
               const In2& pixels, double fx, double fy, double cx, double cy, double scale, double damping,
               const Index2& slots, const In2& shares, bool focal, bool radial, const Array<double, 2>& hessian,
               const Array<double, 1>& gradient, const Array<double, 2>& eliminated,
               const Array<double, 2>& whitened_gradient, const Array<double, 3>& roots,
               const Array<double, 3>& pose_hessian, const std::optional<Array<const double, 1>>& lens) {
    const Observations observations(rotations, centres, points, camera, point, pixels);
    const int64_t size = static_cast<int64_t>(hessian.shape(0)), unknown = size - focal - 2 * radial;
    const auto count = static_cast<size_t>(observations.point_count),
               cameras = static_cast<size_t>(observations.cameras);
    if (static_cast<int64_t>(hessian.shape(1)) != size || static_cast<int64_t>(gradient.shape(0)) != size ||
        static_cast<int64_t>(eliminated.shape(1)) != size || eliminated.shape(0) != 3 * count ||
        whitened_gradient.shape(0) != count || whitened_gradient.shape(1) != 3 || roots.shape(0) != count ||
        roots.shape(1) != 3 || roots.shape(2) != 3 || pose_hessian.shape(0) != cameras || pose_hessian.shape(1) != 6 ||
        pose_hessian.shape(2) != 6 || unknown < 0 || unknown % 6) {
        throw std::invalid_argument(
            "expected hessian [D, D], gradient [D], eliminated [3 P, D], whitened_gradient [P, 3], roots [P, 3, 3], "
            "pose_hessian [C, 6, 6] with D six times the slots, one more for a free focal length and two for a free "
            "lens");
    }
    if (slots.shape(0) != cameras || shares.shape(0) != cameras || shares.shape(1) != slots.shape(1)) {
        throw std::invalid_argument("slots and shares must be [C, K]");
    }
    for (size_t i = 0; i < cameras * slots.shape(1); ++i) {
        if (slots.data()[i] < -1 || slots.data()[i] >= unknown / 6) {
            throw std::invalid_argument("a slot is -1 for a fixed pose, or below the number of slots");
        }
    }
    const System system = {scale,
                           damping,
                           size,
                           unknown,
                           static_cast<int64_t>(slots.shape(1)),
                           slots.data(),
                           shares.data(),
                           hessian.data(),
                           gradient.data(),
                           eliminated.data(),
                           whitened_gradient.data(),
                           roots.data(),
                           focal,
                           radial};
    const Pinhole k = {fx, fy, cx, cy, lens_of(lens)};
    nb::gil_scoped_release release;
    std::fill_n(hessian.data(), size * size, 0.0);
    std::fill_n(gradient.data(), size, 0.0);
    std::fill_n(eliminated.data(), 3 * observations.point_count * size, 0.0);
    PoseSums poses(observations.cameras);
    (k.lens.model ? add_bent_landmarks : add_landmarks)(observations, k, system, poses);
    scatter_to_slots(system, observations.cameras, poses);
    for (int64_t n = 0; n < 6 * observations.cameras; ++n) {
        std::copy_n(poses.hessian.data() + n * kPoseStride, 6, pose_hessian.data() + 6 * n);
    }
}

}  // namespace

void bind_normal_equations(nb::module_& m) {
    m.def("residuals", &residuals, nb::arg("rotations"), nb::arg("centres"), nb::arg("points"), nb::arg("camera"),
          nb::arg("point"), nb::arg("pixels"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"),
          nb::arg("out").noconvert(), nb::arg("lens") = nb::none(),
          "Image minus observation in px, [M, 2]; infinite for a point at or behind its camera.");
    m.def("cost", &cost, nb::arg("rotations"), nb::arg("centres"), nb::arg("points"), nb::arg("camera"),
          nb::arg("point"), nb::arg("pixels"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"),
          nb::arg("scale"), nb::arg("lens") = nb::none(),
          "Mean over observations of the Cauchy loss log(1 + e^2 / scale^2).");
    m.def("linearise", &linearise, nb::arg("rotations"), nb::arg("centres"), nb::arg("points"), nb::arg("camera"),
          nb::arg("point"), nb::arg("pixels"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"),
          nb::arg("scale"), nb::arg("damping"), nb::arg("slots"), nb::arg("shares"), nb::arg("focal"),
          nb::arg("radial"), nb::arg("hessian").noconvert(), nb::arg("gradient").noconvert(),
          nb::arg("eliminated").noconvert(), nb::arg("whitened_gradient").noconvert(), nb::arg("roots").noconvert(),
          nb::arg("pose_hessian").noconvert(), nb::arg("lens") = nb::none(),
          "Hessian [D, D] and gradient [D] of what the poses are made of: slots [C, K] of six numbers each, with\n"
          "shares [C, K], and of the free optics: the logarithm of the focal length, then k1 and k2 of the lens. Each "
          "point's damped 3x3 Hessian V\n"
          "is taken out: with roots R = chol(V)^-1, `eliminated` holds the rows R cross^T and `whitened_gradient` R "
          "gradient.");
}

}  // namespace spiked
