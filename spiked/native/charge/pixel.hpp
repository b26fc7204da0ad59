// The charge loss at one pixel, where it needs no other; a GPU's threads run the same lines (native/gpu).
#pragma once
#include <stdint.h>

#include "../common/device.hpp"
#include "limits.hpp"

namespace spiked {
namespace {

// 1 / variance of the charge before the first and after the last spike.
constexpr float kEdgeWeight = 6.0f;
// Counts are accurate to half a spike, the map to some percent; limits chosen by hand.
constexpr float kAgreeSpikes = 1.2f, kAgreeShare = 0.2f;

// Four image pixels around a position and the weights between them, which is moved into the image.
struct Spot {
    float right, down;
    int32_t column, line;  // of the upper left one
    bool inside;
};

SPIKED_DEVICE SPIKED_INLINED static inline Spot spot_of(float x, float y, float right_edge, float lower_edge) {
    const bool inside = (x >= 0) & (y >= 0) & (x < right_edge) & (y < lower_edge);
    x = x > 0 ? x : 0;
    x = x < right_edge ? x : right_edge;
    y = y > 0 ? y : 0;
    y = y < lower_edge ? y : lower_edge;
    const int32_t column = (int32_t)x, line = (int32_t)y;
    return {x - (float)column, y - (float)line, column, line, inside};
}

// What a pixel has seen of all frames.
struct Gathered {
    float charge, spikes, seen;                    // seen: frames in which it was inside
    float first, last, charge_first, charge_last;  // frames of its spikes, and the charge until then
    float lengths, squares;                        // of intervals: sums of squared lengths and residuals
};

// Its loss, the factor of a residual in its slope, and the slope outside of all intervals.
struct Weighed {
    float loss, inner, outer;
    float chi2, intervals, expected, counted;
    bool enough;
};

SPIKED_DEVICE SPIKED_INLINED static inline Weighed weigh(const Gathered& g, float floor2, float jitter2) {
    const bool some = g.spikes > 0, more = g.spikes > 1;
    const float span = g.last - g.first;
    const float edge = some ? g.charge_first + (g.charge - g.charge_last) - 1 : g.charge;
    const float edge_length = some ? g.seen - span : g.seen;
    const float rate = more ? (g.spikes - 1) / (span > 0 ? span : 1) : 1;
    const float variance = rate * rate * (1.0f / 6) + jitter2;
    const float precision = (more ? g.lengths / variance : 0) + kEdgeWeight * edge_length * edge_length;
    // A pixel that fires in every frame may have received more light.
    const bool saturated = more & (span < g.spikes), above = g.charge > g.spikes;
    const bool enough = g.seen >= kLeastChargeFrames;
    const float scale = enough ? floor2 / (1 + floor2 * precision) : 0;
    Weighed out;
    out.inner = (more & !(saturated & above)) ? 2 * scale / variance : 0;
    out.outer = (saturated & above) ? 0 : 2 * kEdgeWeight * scale * edge;
    out.loss = scale * ((more ? g.squares / variance : 0) + kEdgeWeight * edge * edge);
    out.enough = enough;
    out.chi2 = (enough & more) ? g.squares / variance : 0;
    out.intervals = (enough & more) ? g.spikes - 1 : 0;
    const float off = g.charge - g.spikes > 0 ? g.charge - g.spikes : g.spikes - g.charge;
    const bool agrees = enough & (off < kAgreeSpikes + kAgreeShare * (g.charge + g.spikes));
    out.expected = agrees ? g.charge : 0;
    out.counted = agrees ? g.spikes : 0;
    return out;
}

}  // namespace
}  // namespace spiked
