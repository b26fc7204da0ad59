#include "sensor.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../common/clones.hpp"

namespace spiked {
namespace {

// A counter-based generator: the draw depends only on (seed, frame, pixel), so threads and batches cannot change it.
// 32-bit mixing rounds of the "lowbias32" family (C. Wellons, Prospecting for Hash Functions, public domain).
inline uint32_t mix(uint32_t x) {
    x ^= x >> 16;
    x *= 0x21f0aaadU;
    x ^= x >> 15;
    x *= 0x735a2d97U;
    x ^= x >> 15;
    return x;
}

uint64_t mix64(uint64_t x) {
    x += 0x9e3779b97f4a7c15ULL;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
    return x ^ (x >> 31);
}

// Standard normal from 32 random bits: the sum of four bytes (integers, so the same on every machine), its kurtosis
// corrected by the first Cornish-Fisher term: variance 1, kurtosis 2.9, no value beyond 3.85.
SPIKED_INLINE float normal(uint32_t bits) {
    const uint32_t pairs = (bits & 0x00ff00ffU) + ((bits >> 8) & 0x00ff00ffU);
    const int sum = static_cast<int>((pairs >> 16) + (pairs & 0xffffU)) - 510;
    const float z = static_cast<float>(sum) * (1.0f / 147.80054f);
    return z * (0.9658466f + 0.0125435f * z * z);
}

struct Row {
    const float *first, *last, *gain, *dark, *threshold, *noise_factor;
    float* missing;
    int32_t* fired;
};

SPIKED_CLONES void expose_row(const Row& row, int width, float weight, float global_gain, float jitter, uint32_t key,
                              uint32_t key2, uint32_t first_pixel) {
    const float* __restrict first = row.first;
    const float* __restrict last = row.last;
    const float* __restrict gain = row.gain;
    const float* __restrict dark = row.dark;
    const float* __restrict threshold = row.threshold;
    const float* __restrict noise_factor = row.noise_factor;
    float* __restrict missing = row.missing;
    int32_t* __restrict fired = row.fired;
    for (int x = 0; x < width; ++x) {
        const uint32_t bits = mix((first_pixel + static_cast<uint32_t>(x)) * 0x9e3779b1U ^ key);
        const float light = first[x] + weight * (last[x] - first[x]);
        const float charge = global_gain * gain[x] * light + dark[x];
        const float noise = std::sqrt(std::fabs(charge) * noise_factor[x]) * normal(bits);
        const float left = missing[x] - (charge + noise);
        // Crossings beyond the first within one frame reset the pixel too, but the latch holds one bit: they are lost.
        const float excess = std::max(-left, 0.0f);
        const float lost = static_cast<float>(static_cast<int>(excess / threshold[x])) * threshold[x];
        const float next = threshold[x] * (1.0f + jitter * normal(mix(bits ^ key2))) - (excess - lost);
        // Arithmetic instead of a condition: GCC 12 compiles the condition to a branch, which cannot be vectorised.
        const int32_t spike = left <= 0.0f;
        missing[x] = left + static_cast<float>(spike) * (next - left);
        fired[x] = spike;
    }
}

void pack_row(const int32_t* fired, int width, bool msb_first, uint8_t* out) {
    for (int b = 0; b < width / 8; ++b) {
        int byte = 0;
        for (int bit = 0; bit < 8; ++bit) byte |= fired[8 * b + bit] << (msb_first ? 7 - bit : bit);
        out[b] = static_cast<uint8_t>(byte);
    }
}

}  // namespace

void expose_rows(const Exposure& exposure, const PixelMaps& maps, const FrameFormat& format, float jitter,
                 uint64_t seed, float* missing, uint8_t* out, int row_begin, int row_end) {
    std::vector<int32_t> fired(static_cast<size_t>(format.width));
    const int64_t frame_bytes = static_cast<int64_t>(format.stride) * format.height;
    for (int y = row_begin; y < row_end; ++y) {
        const int64_t at = static_cast<int64_t>(y) * format.width;
        const int stored = format.flipped ? format.height - 1 - y : y;
        const Row row{exposure.first + at, exposure.last + at,     maps.gain + at, maps.dark + at,
                      maps.threshold + at, maps.noise_factor + at, missing + at,   fired.data()};
        for (int64_t k = 0; k < exposure.count; ++k) {
            const uint64_t key = mix64(seed ^ mix64(static_cast<uint64_t>(exposure.first_frame + k)));
            expose_row(row, format.width, exposure.weights[k], exposure.gains[k], jitter, static_cast<uint32_t>(key),
                       static_cast<uint32_t>(key >> 32), static_cast<uint32_t>(at));
            uint8_t* line = out + k * frame_bytes + static_cast<int64_t>(stored) * format.stride;
            pack_row(fired.data(), format.width, format.msb_first, line);
            if (format.row_tagged) {
                line[format.width / 8] = static_cast<uint8_t>(stored & 0xff);
                line[format.width / 8 + 1] = static_cast<uint8_t>(stored >> 8);
            }
        }
    }
}

}  // namespace spiked
