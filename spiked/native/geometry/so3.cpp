// Exponential, logarithm and quaternions of stacks of rotations.
// (J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.)
#include "so3.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "../common/arrays.hpp"

namespace spiked {
namespace {

// wxyz with w >= 0. The largest of the four is found first, so that the divisor is never small (S. W. Shepperd, 1978).
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
        sine < kSmallAngle ? 2 / q[0] * (1 - sine * sine / (3 * q[0] * q[0])) : 2 * std::atan2(sine, q[0]) / sine;
    for (int i = 0; i < 3; ++i) out[i] = scale * q[1 + i];
}

using In = Array<const double, 2>;
using Out = Array<double, 2>;

// Applies a function to each row.
template <void (*kEach)(const double*, double*), size_t kFrom, size_t kTo>
void each(const In& from, const Out& to) {
    if (from.shape(1) != kFrom || to.shape(1) != kTo || from.shape(0) != to.shape(0)) {
        throw std::invalid_argument("expected vectors [n, 3], matrices [n, 9] and quaternions [n, 4]");
    }
    for (size_t n = 0; n < from.shape(0); ++n) kEach(from.data() + kFrom * n, to.data() + kTo * n);
}

}  // namespace
}  // namespace spiked

NB_MODULE(_geometry, m) {
    using namespace spiked;
    const auto from = nb::arg("from");
    const auto to = nb::arg("to").noconvert();
    m.def("exponentials", &each<exponential, 3, 9>, from, to,
          "Rotation matrices [n, 9] of rotation vectors [n, 3] (rad).");
    m.def("logarithms", &each<logarithm, 9, 3>, from, to, "Rotation vectors [n, 3] (rad) of rotation matrices [n, 9].");
    m.def("quaternions", &each<quaternion, 9, 4>, from, to,
          "Unit quaternions wxyz [n, 4], w >= 0, of rotation matrices [n, 9].");
}
