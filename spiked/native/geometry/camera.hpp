// Projection of a point by a camera, with its derivatives by point and pose.
#pragma once
#include <cmath>

#include "lens.hpp"

namespace spiked {

constexpr double kNearest = 1e-6;  // least depth of a point that counts as in front of its camera

struct Pinhole {
    double fx, fy, cx, cy;
    Lens lens = {};
};

// Camera-to-world `rotation` (row-major) and `centre`.
struct Pose {
    const double* rotation;
    const double* centre;
};

// Rotates a vector from camera to world axes.
inline void to_world(const double* rotation, const double* local, double* out) {
    for (int i = 0; i < 3; ++i) {
        out[i] = rotation[3 * i] * local[0] + rotation[3 * i + 1] * local[1] + rotation[3 * i + 2] * local[2];
    }
}

struct Projection {
    double error[2];        // px, projection minus observation
    double ray[3];          // from the camera's centre, in world axes
    double by_point[2][3];  // derivative of the error, px
    bool in_front;
};

// Makes the projection of a camera without distortion that of one with it; `x` and `y` are the point's slopes.
inline void bend_projection(const Pinhole& k, double x, double y, const double* pixel, Projection& projection) {
    const Bent bent = bend(k.lens, x, y);
    projection.error[0] = k.fx * bent.x + k.cx - pixel[0];
    projection.error[1] = k.fy * bent.y + k.cy - pixel[1];
    for (int i = 0; i < 3; ++i) {
        const double u = projection.by_point[0][i], v = projection.by_point[1][i];
        projection.by_point[0][i] = bent.xx * u + bent.xy * k.fx / k.fy * v;
        projection.by_point[1][i] = bent.xy * k.fy / k.fx * u + bent.yy * v;
    }
}

// `Bent`: through the camera's lens.
template <bool Bent>
inline Projection project_by(const Pinhole& k, const Pose& pose, const double* point, const double* pixel) {
    Projection projection;
    const double* r = pose.rotation;
    for (int i = 0; i < 3; ++i) projection.ray[i] = point[i] - pose.centre[i];
    const double x = r[0] * projection.ray[0] + r[3] * projection.ray[1] + r[6] * projection.ray[2];
    const double y = r[1] * projection.ray[0] + r[4] * projection.ray[1] + r[7] * projection.ray[2];
    const double depth = r[2] * projection.ray[0] + r[5] * projection.ray[1] + r[8] * projection.ray[2];
    projection.in_front = depth > kNearest;
    const double near = 1 / (projection.in_front ? depth : kNearest);
    projection.error[0] = k.fx * x * near + k.cx - pixel[0];
    projection.error[1] = k.fy * y * near + k.cy - pixel[1];
    const double along_u = -k.fx * x * near * near, along_v = -k.fy * y * near * near;
    for (int i = 0; i < 3; ++i) {
        projection.by_point[0][i] = k.fx * near * r[3 * i] + along_u * r[3 * i + 2];
        projection.by_point[1][i] = k.fy * near * r[3 * i + 1] + along_v * r[3 * i + 2];
    }
    if constexpr (Bent) bend_projection(k, x * near, y * near, pixel, projection);
    return projection;
}

inline Projection project(const Pinhole& k, const Pose& pose, const double* point, const double* pixel) {
    return k.lens.model ? project_by<true>(k, pose, point, pixel) : project_by<false>(k, pose, point, pixel);
}

// A row of the derivative by the pose (rotation vector on the left, centre) from the row of the derivative by the
// point.
inline void by_pose(const double* by_point, const double* ray, double* out) {
    out[0] = by_point[1] * ray[2] - by_point[2] * ray[1];
    out[1] = by_point[2] * ray[0] - by_point[0] * ray[2];
    out[2] = by_point[0] * ray[1] - by_point[1] * ray[0];
    for (int i = 0; i < 3; ++i) out[3 + i] = -by_point[i];
}

}  // namespace spiked
