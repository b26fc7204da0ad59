// The kernels of spike-aligned windows and their arguments. Plain structs only, see instruction_sets.hpp.
#pragma once
#include <stddef.h>
#include <stdint.h>

#include "../common/instruction_sets.hpp"

namespace spiked {

// The uint8 and uint16 offsets of pixels without a spike.
constexpr uint8_t kNever8 = 0xFF;
constexpr uint16_t kNever16 = 0xFFFF;

// Bytes of the widest load.
constexpr int kMaxLoad = 64;

struct FrameLayout {
    size_t width;  // pixels, a multiple of eight
    size_t height;
    size_t row_stride;  // bytes from one stored row to the next
    size_t padded_row;  // bytes of pixels in a row, rounded up to whole loads of kMaxLoad
    size_t tail_row;    // from this stored row on, a padded row would read past the end of the frame
    bool flipped;
    bool msb;
};

// A run of frames in the order in which they are searched, padded with empty frames to whole blocks of eight.
struct Run {
    const uint8_t* const* frames;  // [blocks * 8]
    const uint8_t* const* tails;   // [blocks * 8], stored rows from FrameLayout::tail_row on, readable past their end
    int blocks;
};

struct WindowJob {
    FrameLayout layout;
    Run before;  // frames begin - 1, begin - 2, ...
    Run inside;  // frames begin, begin + 1, ... end - 1
    Run after;   // frames end, end + 1, ...
    uint16_t begin;
    uint16_t end;
    uint16_t* scratch;  // [kWindowRows * padded_row * 8]
    uint16_t* spikes;
    uint16_t* start;
    uint16_t* stop;
    uint16_t* count;
};
constexpr int kWindowRows = 7;

struct SpikeKernels {
    const char* name;
#define SPIKED_KERNEL(result, name, arguments) result(*name) arguments;
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};
SPIKED_DECLARE_KERNEL_TABLES(SpikeKernels, spike_kernels)

}  // namespace spiked
