// Triangulation of tracks: the point nearest to the rays of all observations, moved by Gauss-Newton steps to that of
// least reprojection error. Without them it is biased towards the cameras: distances from rays are the smaller the
// nearer the point is (R. Hartley and P. Sturm, "Triangulation", 1997).
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "../common/arrays.hpp"
#include "../geometry/camera.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr double kDiagonal = 1e-12;                  // added to the diagonal of a matrix that may be singular
constexpr double kThirdOfTurn = 2.0943951023931953;  // rad
constexpr double kMostStep = 0.3;                    // of the distance from the last camera, in one step

// Sums of I - d d^T over unit rays d, and of the same times the centres that they start from.
struct Rays {
    double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    std::array<double, 3> right = {};
    int64_t count = 0;
    std::array<double, 3> position = {};
    double worst = 0;  // px
    // Of the reprojection errors by the position.
    std::array<double, 6> hessian = {};
    std::array<double, 3> gradient = {};
    double distance = 0;  // from the last camera

    void add(const double* d, const double* c) {
        const double along = d[0] * c[0] + d[1] * c[1] + d[2] * c[2];
        xx += 1 - d[0] * d[0];
        yy += 1 - d[1] * d[1];
        zz += 1 - d[2] * d[2];
        xy -= d[0] * d[1];
        xz -= d[0] * d[2];
        yz -= d[1] * d[2];
        for (int i = 0; i < 3; ++i) right[i] += c[i] - along * d[i];
        ++count;
    }

    void solve() { position = solved({xx + kDiagonal, xy, xz, yy + kDiagonal, yz, zz + kDiagonal}, right); }

    void add_error(const Projection& projection) {
        if (!projection.in_front) return;
        for (int k = 0; k < 2; ++k) {
            const double* row = projection.by_point[k];
            int n = 0;
            for (int i = 0; i < 3; ++i) {
                for (int j = i; j < 3; ++j) hessian[n++] += row[i] * row[j];
                gradient[i] += row[i] * projection.error[k];
            }
        }
        distance = std::hypot(projection.ray[0], projection.ray[1], projection.ray[2]);
    }

    // One Gauss-Newton step of the position; none where the errors do not determine one.
    void step() {
        const double diagonal = kDiagonal * (hessian[0] + hessian[3] + hessian[5]);
        for (const int i : {0, 3, 5}) hessian[i] += diagonal;
        const std::array<double, 3> move = solved(hessian, gradient);
        hessian = {};
        gradient = {};
        const double length = std::hypot(move[0], move[1], move[2]), most = kMostStep * distance;
        if (!std::isfinite(length)) return;
        const double share = length > most ? most / length : 1;
        for (int i = 0; i < 3; ++i) position[i] -= share * move[i];
    }

    // Solves a symmetric system, by cofactors; `m` is its upper triangle by rows.
    static std::array<double, 3> solved(const std::array<double, 6>& m, const std::array<double, 3>& right) {
        const auto [xx, xy, xz, yy, yz, zz] = m;
        const double aa = yy * zz - yz * yz, ab = xz * yz - xy * zz, ac = xy * yz - xz * yy;
        const double bb = xx * zz - xz * xz, bc = xy * xz - xx * yz, cc = xx * yy - xy * xy;
        const double scale = 1 / (xx * aa + xy * ab + xz * ac);
        return {scale * (aa * right[0] + ab * right[1] + ac * right[2]),
                scale * (ab * right[0] + bb * right[1] + bc * right[2]),
                scale * (ac * right[0] + bc * right[1] + cc * right[2])};
    }

    // The sum of squared sines of the angles between the rays and their mean direction: the least eigenvalue, in closed
    // form (O. K. Smith, "Eigenvalues of a symmetric 3x3 matrix", 1961).
    double spread() const {
        const double mean = (xx + yy + zz) / 3, a = xx - mean, b = yy - mean, c = zz - mean;
        const double p = std::sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6);
        if (p == 0) return mean;
        const double det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
        const double angle = std::acos(std::clamp(det / (2 * p * p * p), -1.0, 1.0)) / 3;
        return mean + 2 * p * std::cos(angle + kThirdOfTurn);
    }
};

void triangulate(const Array<const double, 3>& rotations, const Array<const double, 2>& centres,
                 const Array<const int64_t, 1>& view, const Array<const int64_t, 1>& track,
                 const Array<const double, 2>& pixels, double fx, double fy, double cx, double cy, int64_t min_views,
                 double min_spread_px, double max_error_px, const Array<double, 2>& points,
                 const std::optional<Array<const double, 1>>& lens, int steps) {
    const size_t count = view.shape(0), views = centres.shape(0);
    if (rotations.shape(0) != views || rotations.shape(1) != 3 || rotations.shape(2) != 3 || centres.shape(1) != 3 ||
        track.shape(0) != count || pixels.shape(0) != count || pixels.shape(1) != 2 || points.shape(1) != 3) {
        throw std::invalid_argument(
            "expected rotations [V, 3, 3], centres [V, 3], view and track [m], pixels [m, 2], points [P, 3]");
    }
    for (size_t m = 0; m < count; ++m) {
        if (view.data()[m] < 0 || view.data()[m] >= static_cast<int64_t>(views) || track.data()[m] < 0 ||
            track.data()[m] >= static_cast<int64_t>(points.shape(0))) {
            throw std::invalid_argument("an observation names a view or track that does not exist");
        }
    }
    const Pinhole k = {fx, fy, cx, cy, lens_of(lens)};
    nb::gil_scoped_release release;
    std::vector<int64_t> index_of(points.shape(0), -1), ids;
    std::vector<Rays> sums;
    std::vector<size_t> used;
    for (size_t m = 0; m < count; ++m) {
        const int64_t id = track.data()[m];
        if (!std::isnan(points.data()[3 * id])) continue;
        if (index_of[id] < 0) {
            index_of[id] = static_cast<int64_t>(sums.size());
            sums.emplace_back();
            ids.push_back(id);
        }
        used.push_back(m);
        const double *r = rotations.data() + 9 * view.data()[m], *at = pixels.data() + 2 * m;
        double x = (at[0] - cx) / fx, y = (at[1] - cy) / fy;
        straighten(k.lens, x, y);
        const double scale = 1 / std::sqrt(x * x + y * y + 1);
        const double ray[3] = {scale * (r[0] * x + r[1] * y + r[2]), scale * (r[3] * x + r[4] * y + r[5]),
                               scale * (r[6] * x + r[7] * y + r[8])};
        sums[index_of[id]].add(ray, centres.data() + 3 * view.data()[m]);
    }
    for (Rays& rays : sums) rays.solve();
    const auto projected = [&](size_t m, const Rays& rays) {
        const Pose pose = {rotations.data() + 9 * view.data()[m], centres.data() + 3 * view.data()[m]};
        return project(k, pose, rays.position.data(), pixels.data() + 2 * m);
    };
    for (int n = 0; n < steps; ++n) {
        for (const size_t m : used) {
            Rays& rays = sums[index_of[track.data()[m]]];
            rays.add_error(projected(m, rays));
        }
        for (Rays& rays : sums) rays.step();
    }
    for (const size_t m : used) {
        Rays& rays = sums[index_of[track.data()[m]]];
        const Projection projection = projected(m, rays);
        const double error = std::hypot(projection.error[0], projection.error[1]);
        rays.worst = std::max(rays.worst, projection.in_front && error < max_error_px ? error : max_error_px);
    }
    for (size_t n = 0; n < sums.size(); ++n) {
        const Rays& rays = sums[n];
        const double spread_px = std::sqrt(std::max(rays.spread(), 0.0) / static_cast<double>(rays.count)) * fx;
        if (rays.count < min_views || !(spread_px > min_spread_px) || !(rays.worst < max_error_px)) continue;
        std::copy_n(rays.position.data(), 3, points.data() + 3 * ids[n]);
    }
}

}  // namespace

void bind_triangulate(nb::module_& m) {
    m.def("triangulate", &triangulate, nb::arg("rotations"), nb::arg("centres"), nb::arg("view"), nb::arg("track"),
          nb::arg("pixels"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"), nb::arg("min_views"),
          nb::arg("min_spread_px"), nb::arg("max_error_px"), nb::arg("points").noconvert(),
          nb::arg("lens") = nb::none(), nb::arg("steps") = 0,
          "Fills those of `points` [P, 3] that are NaN from the observations of posed views: observation m is of "
          "`track`\n"
          "[m] in `view` [m]. A track is triangulated if at least `min_views` views saw it, its rays spread by more "
          "than\n"
          "`min_spread_px`, and its largest reprojection error is less than `max_error_px`. It is moved by `steps` "
          "Gauss-Newton "
          "steps of these errors.");
}

}  // namespace spiked
