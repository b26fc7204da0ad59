// The inner loops of the plane sweep: the cost of a plane, and the plane of least cost.
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr int64_t kBlock = 1024;  // pixels whose best planes fit in the first-level cache

using Image = Array<float, 2>;
using Input = Array<const float, 2>;

SPIKED_CLONES void add_differences(const float* __restrict warped, const float* __restrict reference,
                                   const float* __restrict weight, int64_t count, float most, float unseen,
                                   float* __restrict total) {
    for (int64_t i = 0; i < count; ++i) {
        const float apart = std::fabs(warped[i] - reference[i]) * weight[i];
        const float bounded = apart < most ? apart : most;
        total[i] += warped[i] == warped[i] ? bounded : unseen;
    }
}

void add_cost(const Input& warped, const Input& reference, const Input& weight, float most, float unseen,
              const Image& total) {
    const size_t count = total.size();
    if (warped.size() != count || reference.size() != count || weight.size() != count)
        throw std::invalid_argument("all images must have the same size");
    nb::gil_scoped_release release;
    add_differences(warped.data(), reference.data(), weight.data(), static_cast<int64_t>(count), most, unseen,
                    total.data());
}

// Best plane of `count` pixels, its cost, and the least cost of the planes more than `apart` away from it.
SPIKED_CLONES void search(const float* __restrict cost, int64_t planes, int64_t stride, int64_t count, float apart,
                          float* __restrict best, float* __restrict least, float* __restrict rival) {
    for (int64_t i = 0; i < count; ++i) {
        best[i] = 0;
        least[i] = cost[i];
        rival[i] = std::numeric_limits<float>::infinity();
    }
    for (int64_t p = 1; p < planes; ++p) {
        const float* __restrict now = cost + p * stride;
        for (int64_t i = 0; i < count; ++i) {
            const bool less = now[i] < least[i];
            best[i] = less ? static_cast<float>(p) : best[i];
            least[i] = less ? now[i] : least[i];
        }
    }
    for (int64_t p = 0; p < planes; ++p) {
        const float* __restrict now = cost + p * stride;
        for (int64_t i = 0; i < count; ++i) {
            const bool far = std::fabs(static_cast<float>(p) - best[i]) > apart;
            rival[i] = far & (now[i] < rival[i]) ? now[i] : rival[i];
        }
    }
}

void best_plane(const Array<const float, 3>& cost, int apart, const Image& plane_number, const Image& margin) {
    const auto planes = static_cast<int64_t>(cost.shape(0));
    const auto pixels = static_cast<int64_t>(cost.shape(1) * cost.shape(2));
    if (planes < 3) throw std::invalid_argument("a sweep has at least three planes");
    if (static_cast<int64_t>(plane_number.size()) != pixels || static_cast<int64_t>(margin.size()) != pixels)
        throw std::invalid_argument("all images must have the same size");
    nb::gil_scoped_release release;
    std::vector<float> best(kBlock), least(kBlock), rival(kBlock);
    for (int64_t from = 0; from < pixels; from += kBlock) {
        const int64_t count = std::min(kBlock, pixels - from);
        const float* here = cost.data() + from;
        search(here, planes, pixels, count, static_cast<float>(apart), best.data(), least.data(), rival.data());
        for (int64_t i = 0; i < count; ++i) {
            const auto plane = static_cast<int64_t>(best[i]);
            const bool inner = plane > 0 && plane < planes - 1;
            const float before = inner ? here[(plane - 1) * pixels + i] : 0,
                        after = inner ? here[(plane + 1) * pixels + i] : 0;
            const float bend = before - 2 * least[i] + after;
            const float offset = inner && bend > 1e-6f ? 0.5f * (before - after) / bend : 0;
            plane_number.data()[from + i] = best[i] + std::clamp(offset, -0.5f, 0.5f);
            margin.data()[from + i] = rival[i] / std::max(least[i], 1e-6f) - 1;
        }
    }
}

}  // namespace

void bind_plane_sweep(nb::module_& m) {
    m.def("add_cost", &add_cost, nb::arg("warped"), nb::arg("reference"), nb::arg("weight"), nb::arg("most"),
          nb::arg("unseen"), nb::arg("total").noconvert(),
          "Adds min(|warped - reference| weight, `most`) to `total`, or `unseen` where the warped image is NaN.");
    m.def("best_plane", &best_plane, nb::arg("cost"), nb::arg("apart"), nb::arg("plane_number").noconvert(),
          nb::arg("margin").noconvert(),
          "Of costs [planes, H, W]: the plane of least cost, to a fraction of a plane by a parabola through its\n"
          "neighbours, and by what share of that cost the best plane more than `apart` away costs more.");
}

}  // namespace spiked
