// The warp of one node, see warp_nodes.cpp; a GPU's threads run the same lines (native/gpu).
#pragma once
#include <stdint.h>

#include "../common/device.hpp"

namespace spiked {
namespace {

struct InverseDepths {
    const float* image;  // [height][width]
    int64_t width;
    float right, lowest;  // of the last pixel
    float shrink;         // its pixels over the sensor's
    float nearest;        // depth
};

// From a node's (x, y), which a camera without distortion sees at (p, r), to its displacement; `bend` makes a position
// of that camera one of the lens.
template <class Bend>
SPIKED_DEVICE inline void warp_node(const InverseDepths& inverse, const float turn[9], const float shift[3], float x,
                                    float y, float p, float r, Bend bend, float out[2]) {
    const float infinity[3] = {turn[0] * p + turn[1] * r + turn[2], turn[3] * p + turn[4] * r + turn[5],
                               turn[6] * p + turn[7] * r + turn[8]};
    float u = x, v = y;
    for (int round = 0; round < 2; ++round) {
        const float a = u * inverse.shrink, b = v * inverse.shrink;
        const auto i = static_cast<int64_t>(a < 0.0f ? 0.0f : inverse.right < a ? inverse.right : a);
        const auto j = static_cast<int64_t>(b < 0.0f ? 0.0f : inverse.lowest < b ? inverse.lowest : b);
        const float q = inverse.image[j * inverse.width + i], depth = infinity[2] + q * shift[2];
        const float z = depth < inverse.nearest ? inverse.nearest : depth;
        u = (infinity[0] + q * shift[0]) / z, v = (infinity[1] + q * shift[1]) / z;
        bend(u, v);
    }
    out[0] = u - x, out[1] = v - y;
}

}  // namespace
}  // namespace spiked
