// The warp of a grid of nodes by depth and pose.
#include <algorithm>
#include <cmath>

#include "../common/arrays.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

// Displacements of nodes `cell` px apart in each frame to their positions p' in an image of inverse depths:
// p' ~ turn p + inverse(p') shift, by two fixed-point iterations.
void warp_nodes(Array<const float, 2> inverse, float shrink, Array<const float, 3> turn, Array<const float, 2> shift,
                float cell, float nearest, Array<float, 4> moved) {
    const size_t frames = moved.shape(0), rows = moved.shape(1), columns = moved.shape(2);
    expect(turn.shape(0) == frames && turn.shape(1) == 3 && turn.shape(2) == 3 && shift.shape(0) == frames &&
               shift.shape(1) == 3 && moved.shape(3) == 2,
           "turn [n, 3, 3], shift [n, 3] and moved [n, rows, columns, 2] disagree");
    expect(inverse.shape(0) > 0 && inverse.shape(1) > 0, "the image is empty");
    const size_t width = inverse.shape(1);
    const float right = static_cast<float>(width - 1), lowest = static_cast<float>(inverse.shape(0) - 1);
    nb::gil_scoped_release release;
    float* out = moved.data();
    for (size_t f = 0; f < frames; ++f) {
        const float *a = turn.data() + 9 * f, *b = shift.data() + 3 * f;
        for (size_t row = 0; row < rows; ++row)
            for (size_t column = 0; column < columns; ++column, out += 2) {
                const float x = cell * static_cast<float>(column), y = cell * static_cast<float>(row);
                const float infinity[3] = {a[0] * x + a[1] * y + a[2], a[3] * x + a[4] * y + a[5],
                                           a[6] * x + a[7] * y + a[8]};
                float u = x, v = y;
                for (int round = 0; round < 2; ++round) {
                    const size_t i = static_cast<size_t>(std::clamp(u * shrink, 0.0f, right));
                    const size_t j = static_cast<size_t>(std::clamp(v * shrink, 0.0f, lowest));
                    const float q = inverse.data()[j * width + i], z = std::max(infinity[2] + q * b[2], nearest);
                    u = (infinity[0] + q * b[0]) / z, v = (infinity[1] + q * b[1]) / z;
                }
                out[0] = u - x, out[1] = v - y;
            }
    }
}

}  // namespace

void bind_warp_nodes(nb::module_& m) {
    m.def("warp_nodes", &warp_nodes, nb::arg("inverse"), nb::arg("shrink"), nb::arg("turn"), nb::arg("shift"),
          nb::arg("cell"), nb::arg("nearest"), nb::arg("moved"));
}

}  // namespace spiked
