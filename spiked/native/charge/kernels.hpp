// The kernel of the charge loss and its arguments: plain data and pointers only, see instruction_sets.hpp.
#pragma once
#include <stdint.h>

#include "../common/instruction_sets.hpp"
#include "limits.hpp"

namespace spiked {

constexpr int kMaxSide = 4096;  // pixels

// Frames of spikes, and an image that is sampled at displaced positions of their pixels (kernels.cpp).
struct ChargeJob {
    int64_t frames, width, height, row_stride, frame_stride;
    int64_t every, phase;  // of `every` pairs of rows, the one of number `phase` is used
    bool flipped, msb;
    uint8_t tile[4];  // the colours of a mosaic's 2x2 sites
    const uint8_t* bytes;
    const float* grids;  // [frames][rows][columns][2], px of the sensor, at nodes `cell` apart
    int64_t rows, columns, cell;
    const float* image;  // [colours][image_height][image_width], expected spikes a frame
    int64_t image_width, image_height;
    int32_t colours;
    float pixel;        // side of an image pixel in sensor pixels
    const float* gain;  // [height][width], 0 for pixels that do not count
    const float* dark;  // [height][width] or null, spikes a frame
    float floor;        // error of the map, spikes a frame
    float jitter;       // of an interval's charge
    float* slope;       // [colours][slope_plane], image rows from slope_row on
    int64_t slope_row, slope_plane;
};

struct ChargeSums {
    double loss, pixels, chi2, intervals, expected, counted;
};

struct ChargeKernels {
    const char* name;
#define SPIKED_KERNEL(result, name, arguments) result(*name) arguments;
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};
SPIKED_DECLARE_KERNEL_TABLES(ChargeKernels, charge_kernels)

}  // namespace spiked
