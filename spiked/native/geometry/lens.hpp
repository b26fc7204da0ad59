// Distortion of a lens, in double precision; spiked/distortion.py has the formulas and their sources.
#pragma once
#include <cmath>
#include <optional>

#include "../common/arrays.hpp"

namespace spiked {

struct Lens {
    int model = 0;      // 0 none, 1 OpenCV's polynomial, 2 fisheye
    double k[5] = {};   // OpenCV: k1 k2 p1 p2 k3; fisheye: k1 k2 k3 k4
    double reach2 = 0;  // square of the largest slope that is imaged
};

// As Python passes it, or none.
inline Lens lens_of(const std::optional<Array<const double, 1>>& given) {
    Lens lens;
    if (!given) return lens;
    expect(given->shape(0) == 7 && (given->data()[0] == 1 || given->data()[0] == 2),
           "a lens is seven numbers, see `Distortion.arguments`");
    lens.model = static_cast<int>(given->data()[0]);
    for (int i = 0; i < 5; ++i) lens.k[i] = given->data()[1 + i];
    lens.reach2 = given->data()[6];
    return lens;
}

// The factor of a slope by its square, and the factor's derivative by the square.
inline void radial(const Lens& lens, double square, double& scale, double& growth) {
    const double* k = lens.k;
    if (lens.model == 1) {
        scale = 1 + square * (k[0] + square * (k[1] + square * k[4]));
        growth = k[0] + square * (2 * k[1] + 3 * square * k[4]);
        return;
    }
    const double r = std::sqrt(square > 1e-10 ? square : 1e-10), angle = std::atan(r), t = angle * angle;
    const double bent = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
    const double by_angle = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])));
    scale = bent / r;
    growth = (by_angle / (1 + r * r) - scale) / (2 * r * r);
}

// Bent slopes, and their derivative by the slopes, which is symmetric.
struct Bent {
    double x, y, xx, xy, yy;
};

inline Bent bend(const Lens& lens, double x, double y) {
    double square = x * x + y * y, scale, growth;
    if (square > lens.reach2) {
        const double shorter = std::sqrt(lens.reach2 / square);
        x *= shorter, y *= shorter, square = lens.reach2;
    }
    radial(lens, square, scale, growth);
    const double p1 = lens.model == 1 ? lens.k[2] : 0, p2 = lens.model == 1 ? lens.k[3] : 0;
    return {x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
            scale + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x, 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y,
            scale + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x};
}

// Replaces bent slopes by the slopes, by Newton's method.
inline void straighten(const Lens& lens, double& x, double& y) {
    constexpr int kSteps = 30;
    constexpr double kTolerance = 1e-12, kLeastDeterminant = 1e-9;
    if (!lens.model) return;
    const double bent_x = x, bent_y = y;
    for (int step = 0; step < kSteps; ++step) {
        const Bent at = bend(lens, x, y);
        const double u = at.x - bent_x, v = at.y - bent_y;
        double determinant = at.xx * at.yy - at.xy * at.xy;
        if (!(determinant > kLeastDeterminant)) determinant = kLeastDeterminant;
        double to_x = x - (at.yy * u - at.xy * v) / determinant, to_y = y - (at.xx * v - at.xy * u) / determinant;
        const double square = to_x * to_x + to_y * to_y;
        if (square > lens.reach2) {
            const double shorter = std::sqrt(lens.reach2 / square);
            to_x *= shorter, to_y *= shorter;
        }
        const double moved = std::abs(to_x - x) + std::abs(to_y - y);
        x = to_x, y = to_y;
        if (moved < kTolerance) break;
    }
}

}  // namespace spiked
