// What the kernels are asked to do. Plain structs only: every instruction set's translation unit includes this file.
#pragma once
#include <stddef.h>
#include <stdint.h>

namespace spiked {

// "No spike here" in the uint8 and uint16 offsets.
constexpr uint8_t kNever8 = 0xFF;
constexpr uint16_t kNever16 = 0xFFFF;

// Bytes of the widest load.
constexpr int kMaxLoad = 64;

struct Geometry {
    size_t width;  // pixels, a multiple of eight
    size_t height;
    size_t row_stride;  // bytes from one stored row to the next
    size_t padded_row;  // bytes of pixels in a row, rounded up to whole loads of kMaxLoad
    size_t tail_row;    // from this stored row on, a padded row would read past the end of the frame
    bool flipped;
    bool msb;
};

// A run of frames in the order in which they are looked at, padded with empty frames to whole blocks of eight.
struct Run {
    const uint8_t* const* frames;  // [blocks * 8]
    const uint8_t* const* tails;   // [blocks * 8], stored rows from Geometry::tail_row on, readable past their end
    int blocks;
};

struct ReduceJob {
    Geometry geometry;
    Run run;  // one block
    uint8_t* count;
    uint8_t* first;
    uint8_t* last;
};

struct WindowJob {
    Geometry geometry;
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

struct Kernels {
    const char* name;
    void (*reduce)(const ReduceJob&);
    void (*window)(const WindowJob&);
    void (*unpack)(const uint8_t* row, size_t bytes, bool msb, uint8_t* pixels);  // eight pixels a byte, 0 or 1
};

// Null where the instruction set was not compiled in.
const Kernels* baseline_kernels();
const Kernels* avx2_kernels();
const Kernels* avx512_kernels();
const Kernels* neon_kernels();

}  // namespace spiked
