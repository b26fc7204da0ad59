#pragma once
#include <cstdint>

namespace spiked {

// The fixed part of a pixel, upright row-major, one float a pixel; charges in nominal thresholds (= expected spikes).
struct PixelMaps {
    const float* gain;          // share of the radiance that becomes charge
    const float* dark;          // dark current a frame
    const float* threshold;     // capacitance mismatch and reset bias
    const float* noise_factor;  // square of the shot noise of one unit of charge: 1 / electrons a spike
};

struct FrameFormat {
    int width, height, stride;
    bool flipped, msb_first, row_tagged;
};

struct Exposure {
    const float* first;    // radiance at the start of the span, [height, width]
    const float* last;     // and at its end
    const float* weights;  // of `last` in each frame, [count]
    const float* gains;    // global gain of each frame, [count]
    int64_t first_frame;
    int64_t count;
};

// Exposes rows [row_begin, row_end) for all frames; `missing` is the charge still missing to each pixel's next spike.
void expose_rows(const Exposure& exposure, const PixelMaps& maps, const FrameFormat& format, float jitter,
                 uint64_t seed, float* missing, uint8_t* out, int row_begin, int row_end);

}  // namespace spiked
