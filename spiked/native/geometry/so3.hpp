// The exponential of SO(3).
#pragma once
#include <cmath>

namespace spiked {

constexpr double kSmallAngle = 1e-4;  // rad; below it the series are used: their next term is under 1e-16

// Rotation matrix (row-major) of a rotation vector (rad), by the formula of Rodrigues.
inline void exponential(const double* v, double* out) {
    const double x = v[0], y = v[1], z = v[2], square = x * x + y * y + z * z, angle = std::sqrt(square);
    const bool small = angle < kSmallAngle;
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

}  // namespace spiked
