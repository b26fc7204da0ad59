// Rotations in stacks: exponential, logarithm and quaternions.
// (J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.)
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "arrays.hpp"

namespace spiked {
namespace {

constexpr double kSmall = 1e-4;  // rad; below it series are used, whose next term is under 1e-16

void exponential(const double* v, double* out) {
    const double x = v[0], y = v[1], z = v[2], square = x * x + y * y + z * z, angle = std::sqrt(square);
    const bool small = angle < kSmall;
    const double a = small ? 1 - square / 6 : std::sin(angle) / angle;
    const double b = small ? 0.5 - square / 24 : (1 - std::cos(angle)) / square;
    out[0] = 1 - b * (y * y + z * z);
    out[1] = b * x * y - a * z;
    out[2] = b * x * z + a * y;
    out[3] = b * x * y + a * z;
    out[4] = 1 - b * (x * x + z * z);
    out[5] = b * y * z - a * x;
    out[6] = b * x * z - a * y;
    out[7] = b * y * z + a * x;
    out[8] = 1 - b * (x * x + y * y);
}

// wxyz with w >= 0. The largest of the four is found first, so that no division is by a small number (Shepperd 1978).
void quaternion(const double* m, double* q) {
    const double trace = m[0] + m[4] + m[8];
    const double px = m[7] - m[5], py = m[2] - m[6], pz = m[3] - m[1];
    const double sx = m[3] + m[1], sy = m[2] + m[6], sz = m[7] + m[5];
    const double rows[4][4] = {{1 + trace, px, py, pz},
                               {px, 1 + 2 * m[0] - trace, sx, sy},
                               {py, sx, 1 + 2 * m[4] - trace, sz},
                               {pz, sy, sz, 1 + 2 * m[8] - trace}};
    const double squares[4] = {trace, m[0], m[4], m[8]};
    const double* row = rows[std::max_element(squares, squares + 4) - squares];
    double length = std::sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]);
    if (row[0] < 0) length = -length;
    for (int i = 0; i < 4; ++i) q[i] = row[i] / length;
}

void logarithm(const double* m, double* out) {
    double q[4];
    quaternion(m, q);
    const double sine = std::sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double scale =
        sine < kSmall ? 2 / q[0] * (1 - sine * sine / (3 * q[0] * q[0])) : 2 * std::atan2(sine, q[0]) / sine;
    for (int i = 0; i < 3; ++i) out[i] = scale * q[1 + i];
}

using In = Array<const double, 2>;
using Out = Array<double, 2>;

template <void (*kEach)(const double*, double*), size_t kFrom, size_t kTo>
void all(const In& from, const Out& to) {
    if (from.shape(1) != kFrom || to.shape(1) != kTo || from.shape(0) != to.shape(0)) {
        throw std::invalid_argument("expected vectors [n, 3], matrices [n, 9] and quaternions [n, 4]");
    }
    for (size_t n = 0; n < from.shape(0); ++n) kEach(from.data() + kFrom * n, to.data() + kTo * n);
}

}  // namespace

void bind_rotation(nb::module_& m) {
    const auto from = nb::arg("from");
    const auto to = nb::arg("to").noconvert();
    m.def("exponentials", &all<exponential, 3, 9>, from, to,
          "Rotation matrices [n, 9] of rotation vectors [n, 3] (rad).");
    m.def("logarithms", &all<logarithm, 9, 3>, from, to, "Rotation vectors [n, 3] (rad) of rotation matrices [n, 9].");
    m.def("quaternions", &all<quaternion, 9, 4>, from, to,
          "Unit quaternions wxyz [n, 4], w >= 0, of rotation matrices [n, 9].");
}

}  // namespace spiked
