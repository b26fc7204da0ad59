// The inner loop of the mesh: distances of voxels to the surface that a depth image shows.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>

#include "../common/arrays.hpp"
#include "../geometry/lens.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr double kNearest = 1e-9;  // least z of a voxel that counts as in front of the camera

struct View {
    const float* depth;
    int64_t width, height;
    const double* focal;  // fx, fy, cx, cy
    Lens lens;
};

// Depth at slopes (x, y), of the nearest pixel; 0 outside.
inline double depth_at(const View& view, double x, double y) {
    if (view.lens.model) {
        const Bent bent = bend(view.lens, x, y);
        x = bent.x, y = bent.y;
    }
    const double u = view.focal[0] * x + view.focal[2], v = view.focal[1] * y + view.focal[3];
    if (!(u >= 0 && v >= 0 && u < static_cast<double>(view.width) && v < static_cast<double>(view.height))) return 0;
    return view.depth[static_cast<int64_t>(v) * view.width + static_cast<int64_t>(u)];
}

void add_distances(const Array<const double, 2>& corners, double step, int side, const Array<const float, 2>& depth,
                   const Array<const double, 2>& rotation, const Array<const double, 1>& centre,
                   const Array<const double, 1>& focal, double reach, const Array<float, 2>& total,
                   const Array<int32_t, 2>& seen, const std::optional<Array<const double, 1>>& lens) {
    const auto voxels = static_cast<size_t>(side) * side * side;
    expect(side > 0 && corners.shape(1) == 3, "corners have the shape [n, 3], and a block has a side");
    expect(rotation.shape(0) == 3 && rotation.shape(1) == 3 && centre.shape(0) == 3, "a pose is [3, 3] and [3]");
    expect(focal.shape(0) == 4, "fx, fy, cx and cy are four numbers");
    expect(total.shape(0) == corners.shape(0) && seen.shape(0) == corners.shape(0), "one row of sums for each block");
    expect(total.shape(1) == voxels && seen.shape(1) == voxels, "one sum for each voxel of a block");
    const View view{depth.data(), static_cast<int64_t>(depth.shape(1)), static_cast<int64_t>(depth.shape(0)),
                    focal.data(), lens_of(lens)};
    nb::gil_scoped_release release;
    const double* r = rotation.data();
    for (size_t block = 0; block < corners.shape(0); ++block) {
        double first[3];  // the first voxel, in camera axes
        for (int i = 0; i < 3; ++i) {
            first[i] = 0;
            for (int k = 0; k < 3; ++k) {
                first[i] += r[3 * k + i] * (corners.data()[3 * block + k] + 0.5 * step - centre.data()[k]);
            }
        }
        float* sum = total.data() + block * voxels;
        int32_t* count = seen.data() + block * voxels;
        for (int a = 0; a < side; ++a) {
            for (int b = 0; b < side; ++b) {
                for (int c = 0; c < side; ++c, ++sum, ++count) {
                    const double x = first[0] + step * (a * r[0] + b * r[3] + c * r[6]);
                    const double y = first[1] + step * (a * r[1] + b * r[4] + c * r[7]);
                    const double z = first[2] + step * (a * r[2] + b * r[5] + c * r[8]);
                    if (!(z > kNearest)) continue;
                    const double shown = depth_at(view, x / z, y / z), signed_distance = shown - z;
                    if (!(shown > 0 && signed_distance > -reach)) continue;
                    *sum += static_cast<float>(std::min(signed_distance / reach, 1.0));
                    ++*count;
                }
            }
        }
    }
}

}  // namespace

void bind_signed_distance(nb::module_& m) {
    m.def("add_distances", &add_distances, nb::arg("corners"), nb::arg("step"), nb::arg("side"), nb::arg("depth"),
          nb::arg("rotation"), nb::arg("centre"), nb::arg("camera"), nb::arg("reach"), nb::arg("total").noconvert(),
          nb::arg("seen").noconvert(), nb::arg("lens") = nb::none(),
          "For blocks of side^3 voxels with these corners [n, 3]: adds min(distance / reach, 1) in front of the\n"
          "surface that a depth image shows, and down to -1 behind it, and counts the voxels that it was added to.");
}

}  // namespace spiked
