// The warp of a grid of nodes by depth and pose.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>

#include "../common/arrays.hpp"
#include "../geometry/camera.hpp"
#include "bindings.hpp"
#include "warp_node.hpp"

namespace spiked {
namespace {

// Displacements of nodes `cell` px apart in each frame to their positions p' in an image of inverse depths:
// p' ~ turn p + inverse(p') shift, by two fixed-point iterations. Through a lens, p is where a camera without
// distortion sees what the node sees, `straight`, and p' is bent.
void warp_nodes(Array<const float, 2> inverse, float shrink, Array<const float, 3> turn, Array<const float, 2> shift,
                float cell, float nearest, Array<float, 4> moved, std::optional<Array<const float, 3>> straight,
                std::optional<Array<const double, 1>> camera, std::optional<Array<const double, 1>> given) {
    const size_t frames = moved.shape(0), rows = moved.shape(1), columns = moved.shape(2);
    expect(turn.shape(0) == frames && turn.shape(1) == 3 && turn.shape(2) == 3 && shift.shape(0) == frames &&
               shift.shape(1) == 3 && moved.shape(3) == 2,
           "turn [n, 3, 3], shift [n, 3] and moved [n, rows, columns, 2] disagree");
    expect(inverse.shape(0) > 0 && inverse.shape(1) > 0, "the image is empty");
    expect(straight.has_value() == given.has_value() && straight.has_value() == camera.has_value(),
           "a lens comes with its camera and with straight nodes");
    expect(!straight || (straight->shape(0) == rows && straight->shape(1) == columns && straight->shape(2) == 2 &&
                         camera->shape(0) == 4),
           "straight nodes are [rows, columns, 2], and the camera is fx, fy, cx, cy");
    Pinhole k = {1, 1, 0, 0, lens_of(given)};
    if (camera) k.fx = camera->data()[0], k.fy = camera->data()[1], k.cx = camera->data()[2], k.cy = camera->data()[3];
    const size_t height = inverse.shape(0), width = inverse.shape(1);
    const InverseDepths depths{inverse.data(),
                               static_cast<int64_t>(width),
                               static_cast<float>(width - 1),
                               static_cast<float>(height - 1),
                               shrink,
                               nearest};
    const auto bent = [&](float& u, float& v) {
        if (!k.lens.model) return;
        const Bent at = bend(k.lens, (u - k.cx) / k.fx, (v - k.cy) / k.fy);
        u = static_cast<float>(k.fx * at.x + k.cx), v = static_cast<float>(k.fy * at.y + k.cy);
    };
    nb::gil_scoped_release release;
    float* out = moved.data();
    for (size_t f = 0; f < frames; ++f) {
        const float *a = turn.data() + 9 * f, *b = shift.data() + 3 * f;
        for (size_t row = 0; row < rows; ++row)
            for (size_t column = 0; column < columns; ++column, out += 2) {
                const float x = cell * static_cast<float>(column), y = cell * static_cast<float>(row);
                const float* from = straight ? straight->data() + 2 * (row * columns + column) : nullptr;
                warp_node(depths, a, b, x, y, from ? from[0] : x, from ? from[1] : y, bent, out);
            }
    }
}

}  // namespace

void bind_warp_nodes(nb::module_& m) {
    m.def("warp_nodes", &warp_nodes, nb::arg("inverse"), nb::arg("shrink"), nb::arg("turn"), nb::arg("shift"),
          nb::arg("cell"), nb::arg("nearest"), nb::arg("moved").noconvert(), nb::arg("straight") = nb::none(),
          nb::arg("camera") = nb::none(), nb::arg("lens") = nb::none());
}

}  // namespace spiked
