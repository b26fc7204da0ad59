// A pinhole camera at a pose, and how the image of a point moves with both.
#pragma once
#include <cmath>

namespace spiked {

constexpr double kNearest = 1e-6;  // a point must lie at least so far in front of its camera

struct Pinhole {
    double fx, fy, cx, cy;
};

// Camera-to-world `rotation` (row-major) and `centre`.
struct Pose {
    const double* rotation;
    const double* centre;
};

// A vector in camera axes, in those of the world.
inline void to_world(const double* rotation, const double* local, double* out) {
    for (int i = 0; i < 3; ++i) {
        out[i] = rotation[3 * i] * local[0] + rotation[3 * i + 1] * local[1] + rotation[3 * i + 2] * local[2];
    }
}

struct Seen {
    double error[2];  // px: image minus observation
    double ray[3];    // from the camera's centre, in world axes
    double by_point[2][3];
    bool in_front;
};

inline Seen look(const Pinhole& k, const Pose& pose, const double* point, const double* pixel) {
    Seen seen;
    const double* r = pose.rotation;
    for (int i = 0; i < 3; ++i) seen.ray[i] = point[i] - pose.centre[i];
    const double x = r[0] * seen.ray[0] + r[3] * seen.ray[1] + r[6] * seen.ray[2];
    const double y = r[1] * seen.ray[0] + r[4] * seen.ray[1] + r[7] * seen.ray[2];
    const double depth = r[2] * seen.ray[0] + r[5] * seen.ray[1] + r[8] * seen.ray[2];
    seen.in_front = depth > kNearest;
    const double near = 1 / (seen.in_front ? depth : kNearest);
    seen.error[0] = k.fx * x * near + k.cx - pixel[0];
    seen.error[1] = k.fy * y * near + k.cy - pixel[1];
    const double along_u = -k.fx * x * near * near, along_v = -k.fy * y * near * near;
    for (int i = 0; i < 3; ++i) {
        seen.by_point[0][i] = k.fx * near * r[3 * i] + along_u * r[3 * i + 2];
        seen.by_point[1][i] = k.fy * near * r[3 * i + 1] + along_v * r[3 * i + 2];
    }
    return seen;
}

// One row of the derivative by the pose (rotation vector on the left, centre), from that by the point.
inline void by_pose(const double* by_point, const double* ray, double* out) {
    out[0] = by_point[1] * ray[2] - by_point[2] * ray[1];
    out[1] = by_point[2] * ray[0] - by_point[0] * ray[2];
    out[2] = by_point[0] * ray[1] - by_point[1] * ray[0];
    for (int i = 0; i < 3; ++i) out[3 + i] = -by_point[i];
}

}  // namespace spiked
