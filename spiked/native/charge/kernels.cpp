// The charge loss: compares spikes with an image warped along its motion. The light that a pixel gathers between two of
// its spikes is exactly one threshold. Plain loops over kPixels pixels of a row, which the compiler vectorises for each
// instruction set.
//
// Neighbouring pixels of a frame are mostly neighbours in the image, too. Where they are, kLanes of them are read and
// written at once. The image has a plane for each colour; a row of a mosaic uses two of them alternately.
#include "kernels.hpp"

#include "../common/simd.hpp"
#include "pixel.hpp"

namespace spiked {
namespace {

constexpr int kPixels = 64, kRuns = kPixels / kLanes;

static inline Int lanes() {
    Int number;
    for (int i = 0; i < kLanes; ++i) number[i] = i;
    return number;
}
static inline Vec alternate(Vec even, Vec odd) { return (lanes() & 1) != 0 ? odd : even; }

struct ChargeWork {
    float light[kMaxChargeFrames][kPixels];                                     // expected charge of a frame
    float right[kMaxChargeFrames][kPixels], down[kMaxChargeFrames][kPixels];    // between the four image pixels
    int32_t at[kMaxChargeFrames][kPixels];                                      // the upper left one, in a plane
    bool run[kMaxChargeFrames][kRuns];                                          // whether kLanes of them are adjacent
    float inside[kMaxChargeFrames][kPixels], spike[kMaxChargeFrames][kPixels];  // 0 or 1
    float slope[kMaxChargeFrames][kPixels];
};

struct ChargeRow {
    const float* gain;
    const float* dark;     // may be null
    const uint8_t* bytes;  // of the first frame
    const float* lines;    // the displacements of the grids' columns on this row, [frames][columns][2]
    int64_t y;
    int32_t even, odd;  // colours of this row's pixels
};

// The bits of 64 pixels, those beyond `count` 0; pixel 0 is the lowest.
static inline uint64_t spikes_of(const uint8_t* bytes, int count, bool msb) {
    uint64_t word = 0;
    for (int k = 0; 8 * k < count; ++k) word |= (uint64_t)bytes[k] << (8 * k);
    if (!msb) return word;
    word = (word >> 1 & 0x5555555555555555u) | (word & 0x5555555555555555u) << 1;
    word = (word >> 2 & 0x3333333333333333u) | (word & 0x3333333333333333u) << 2;
    return (word >> 4 & 0x0f0f0f0f0f0f0f0fu) | (word & 0x0f0f0f0f0f0f0f0fu) << 4;
}

// Whether kLanes positions are adjacent.
static inline bool side_by_side(const int32_t* at) {
    Int place;
    __builtin_memcpy(&place, at, sizeof place);
    const Int apart = place - at[0] - lanes();
    return !any_ge(__builtin_convertvector(apart & 0x7fffffff, Vec), broadcast(0.5f));
}

// Light and spikes of `count` pixels from column x0 on, in all frames.
static void gather(const ChargeJob& job, const ChargeRow& row, int64_t x0, int count, ChargeWork& work) {
    const float step = 1.0f / (float)job.cell, shrink = 1.0f / job.pixel;
    const float right_edge = (float)job.image_width - 1.001f, lower_edge = (float)job.image_height - 1.001f;
    const int32_t stride = (int32_t)job.image_width;
    const int64_t plane = job.image_height * job.image_width;
    const float *even = job.image + row.even * plane, *odd = job.image + row.odd * plane;
    float gain[kPixels], dark[kPixels];
    for (int i = 0; i < kPixels; ++i) {
        const bool there = i < count;
        gain[i] = there ? row.gain[x0 + i] : 0;
        dark[i] = there && row.dark ? row.dark[x0 + i] : 0;
    }
    for (int64_t f = 0; f < job.frames; ++f) {
        const uint8_t* bytes = row.bytes + f * job.frame_stride + x0 / 8;
        float* spike = work.spike[f];
        const uint64_t word = spikes_of(bytes, count, job.msb);
        for (int from = 0; from < kPixels; from += kLanes) {
            const Int some = (Int{} + (int32_t)(word >> from & ((1u << kLanes) - 1))) >> lanes();
            store(spike + from, __builtin_convertvector(some & 1, Vec));
        }
        const float* line = row.lines + f * job.columns * 2;
        float dx[kPixels], dy[kPixels];
        for (int from = 0; from < kPixels; from += 8) {
            const int64_t column = (x0 + from) / job.cell;
            const float* a = line + 2 * (column < job.columns - 2 ? column : job.columns - 2);
            const float begin = (float)((x0 + from) % job.cell) + 0.5f;
            const float by_x = (a[2] - a[0]) * step, by_y = (a[3] - a[1]) * step;
            for (int i = 0; i < 8; ++i) {
                dx[from + i] = a[0] + (begin + (float)i) * by_x;
                dy[from + i] = a[1] + (begin + (float)i) * by_y;
            }
        }
        float *light = work.light[f], *right = work.right[f], *down = work.down[f], *inside = work.inside[f];
        int32_t* at = work.at[f];
        for (int i = 0; i < kPixels; ++i) {
            const Spot spot = spot_of(((float)(x0 + i) + 0.5f + dx[i]) * shrink - 0.5f,
                                      ((float)row.y + 0.5f + dy[i]) * shrink - 0.5f, right_edge, lower_edge);
            inside[i] = spot.inside ? 1.0f : 0.0f;
            right[i] = spot.right;
            down[i] = spot.down;
            at[i] = spot.line * stride + spot.column;
        }
        for (int r = 0; r < kRuns; ++r) {
            const int from = r * kLanes;
            const bool run = work.run[f][r] = side_by_side(at + from);
            if (run) {
                const float *e = even + at[from], *o = odd + at[from];
                const Vec u = load(right + from), v = load(down + from);
                const Vec a = alternate(load(e), load(o)), b = alternate(load(e + 1), load(o + 1));
                const Vec c = alternate(load(e + stride), load(o + stride));
                const Vec d = alternate(load(e + stride + 1), load(o + stride + 1));
                const Vec above = a + u * (b - a), below = c + u * (d - c);
                store(light + from, load(gain + from) * (above + v * (below - above)) + load(dark + from));
            } else {
                for (int i = from; i < from + kLanes; ++i) {
                    const float* p = (i & 1 ? odd : even) + at[i];
                    const float above = p[0] + right[i] * (p[1] - p[0]);
                    const float below = p[stride] + right[i] * (p[stride + 1] - p[stride]);
                    light[i] = gain[i] * (above + down[i] * (below - above)) + dark[i];
                }
            }
        }
    }
    for (int64_t f = 0; f < job.frames; ++f)
        for (int i = 0; i < kPixels; ++i) {
            work.spike[f][i] *= gain[i] > 0 ? work.inside[f][i] : 0;
            work.inside[f][i] = gain[i] > 0 ? work.inside[f][i] : 0;
        }
}

// Residuals of the intervals, and the slope of the loss by the light of each frame.
static void residual(const ChargeJob& job, const ChargeRow& row, int64_t x0, ChargeWork& work, ChargeSums& sums) {
    const float floor2 = job.floor * job.floor, jitter2 = job.jitter * job.jitter;
    float charge[kPixels] = {}, spikes[kPixels] = {}, residual[kPixels] = {}, squares[kPixels] = {};
    float first[kPixels] = {}, last[kPixels] = {}, charge_first[kPixels] = {}, charge_last[kPixels] = {};
    float lengths[kPixels] = {}, seen[kPixels] = {};
    for (int64_t f = 0; f < job.frames; ++f) {
        const float t = (float)f;
        for (int i = 0; i < kPixels; ++i) {
            const float in = work.inside[f][i], hit = work.spike[f][i];
            // It fires at an unknown time in the frame: on average at its middle.
            const float half = 0.5f * in * work.light[f][i], full = charge[i] + half;
            charge[i] = full + half;
            seen[i] += in;
            const float now = full - spikes[i];
            const bool begins = (hit > 0) & (spikes[i] == 0);
            const float length = begins ? 0 : t - last[i];
            const float wrong = begins ? 0 : now - residual[i];
            first[i] = begins ? t : first[i];
            charge_first[i] = begins ? full : charge_first[i];
            last[i] = hit > 0 ? t : last[i];
            charge_last[i] = hit > 0 ? full : charge_last[i];
            residual[i] = hit > 0 ? now : residual[i];
            lengths[i] += hit * length * length;
            squares[i] += hit * wrong * wrong;
            work.slope[f][i] = wrong;
            spikes[i] += hit;
        }
    }
    float inner[kPixels], outer[kPixels];  // factor of a residual; the slope outside of all intervals
    for (int i = 0; i < kPixels; ++i) {
        const Weighed weighed = weigh(
            {charge[i], spikes[i], seen[i], first[i], last[i], charge_first[i], charge_last[i], lengths[i], squares[i]},
            floor2, jitter2);
        inner[i] = weighed.inner;
        outer[i] = weighed.outer;
        sums.loss += weighed.loss;
        sums.pixels += weighed.enough;
        sums.chi2 += weighed.chi2;
        sums.intervals += weighed.intervals;
        sums.expected += weighed.expected;
        sums.counted += weighed.counted;
    }
    float after[kPixels];
    for (int i = 0; i < kPixels; ++i) after[i] = outer[i];
    for (int64_t f = job.frames - 1; f >= 0; --f) {
        const float t = (float)f;
        for (int i = 0; i < kPixels; ++i) {
            const float before = t > first[i] ? inner[i] * work.slope[f][i] : outer[i];
            const float now = work.spike[f][i] > 0 ? before : after[i];
            work.slope[f][i] = work.inside[f][i] * 0.5f * (now + after[i]);
            after[i] = now;
        }
    }
    for (int i = 0; i < kPixels && x0 + i < job.width; ++i) charge[i] = row.gain[x0 + i];
    for (int64_t f = 0; f < job.frames; ++f)
        for (int i = 0; i < kPixels; ++i) work.slope[f][i] *= charge[i];
}

// The transpose of gather(): each slope goes to the four image pixels that its light came from.
static void scatter(const ChargeJob& job, const ChargeRow& row, int count, const ChargeWork& work) {
    const int32_t stride = (int32_t)job.image_width;
    float* even = job.slope + row.even * job.slope_plane - job.slope_row * (int64_t)stride;
    float* odd = job.slope + row.odd * job.slope_plane - job.slope_row * (int64_t)stride;
    for (int64_t f = 0; f < job.frames; ++f) {
        float left[2][kPixels + 1], right_of[2][kPixels + 1];  // of the upper and the lower line
        float* right[2] = {right_of[0] + 1, right_of[1] + 1};
        for (int i = 0; i < kPixels; ++i) {
            const float lower = work.slope[f][i] * work.down[f][i], upper = work.slope[f][i] - lower;
            right[0][i] = upper * work.right[f][i], right[1][i] = lower * work.right[f][i];
            left[0][i] = upper - right[0][i], left[1][i] = lower - right[1][i];
        }
        for (int line = 0; line < 2; ++line) left[line][kPixels] = right_of[line][0] = 0;
        // Sums of every second pixel, for both sides of it, adjacent in memory.
        for (int r = 0; r < kRuns; ++r) {
            if (!work.run[f][r]) continue;
            const int from = r * kLanes;
            float* p = even + work.at[f][from];
            for (int line = 0; line < 2; ++line, p += stride)
                store(p, load(p) + alternate(load(left[line] + from), load(right[line] + from - 1)));
        }
        for (int r = 0; r < kRuns; ++r) {
            if (!work.run[f][r]) continue;
            const int from = r * kLanes;
            float* p = odd + work.at[f][from] + 1;
            for (int line = 0; line < 2; ++line, p += stride)
                store(p, load(p) + alternate(load(left[line] + from + 1), load(right[line] + from)));
        }
        for (int r = 0; r < kRuns; ++r) {
            if (work.run[f][r]) continue;
            for (int i = r * kLanes; i < (r + 1) * kLanes && i < count; ++i) {
                float* p = (i & 1 ? odd : even) + work.at[f][i];
                p[0] += left[0][i];
                p[1] += right[0][i];
                p[stride] += left[1][i];
                p[stride + 1] += right[1][i];
            }
        }
    }
}

static void charge(const ChargeJob& job, int64_t first_row, int64_t last_row, float* lines, void* scratch,
                   ChargeSums& sums) {
    ChargeWork& work = *(ChargeWork*)scratch;
    for (int64_t y = first_row; y < last_row; ++y) {
        if (y / 2 % job.every != job.phase) continue;
        const float place = ((float)y + 0.5f) / (float)job.cell;
        const int64_t upper = (int64_t)place < job.rows - 2 ? (int64_t)place : job.rows - 2;
        const float share = place - (float)upper;
        for (int64_t f = 0; f < job.frames; ++f) {
            const float* a = job.grids + (f * job.rows + upper) * job.columns * 2;
            const float* b = a + job.columns * 2;
            float* line = lines + f * job.columns * 2;
            for (int64_t k = 0; k < 2 * job.columns; ++k) line[k] = a[k] + share * (b[k] - a[k]);
        }
        const bool mixed = job.colours > 1;
        const int64_t stored = job.flipped ? job.height - 1 - y : y;
        const ChargeRow row = {job.gain + y * job.width,
                               job.dark ? job.dark + y * job.width : nullptr,
                               job.bytes + stored * job.row_stride,
                               lines,
                               y,
                               mixed ? job.tile[(y & 1) * 2] : 0,
                               mixed ? job.tile[(y & 1) * 2 + 1] : 0};
        for (int64_t x = 0; x < job.width; x += kPixels) {
            const int count = (int)(job.width - x < kPixels ? job.width - x : kPixels);
            gather(job, row, x, count, work);
            residual(job, row, x, work, sums);
            scatter(job, row, count, work);
        }
    }
}

static int64_t charge_scratch() { return (int64_t)sizeof(ChargeWork); }

}  // namespace

const ChargeKernels SPIKED_KERNEL_TABLE(charge_kernels) = {
    SPIKED_INSTRUCTION_SET_NAME,
#define SPIKED_KERNEL(result, name, arguments) name,
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};

}  // namespace spiked
