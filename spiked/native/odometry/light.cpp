// From windows between spikes to pictures: rates, their noise, and when each pixel looked.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "../clones.hpp"
#include "arrays.hpp"

namespace spiked {
namespace {

constexpr uint16_t kNever = 0xFFFF;
constexpr int kReach = 6;  // px from the middle of a track's window to its edge
constexpr int kColumns = 16;

// Half-precision bits of a number that they hold exactly, or nearly.
inline uint16_t half(float value) {
    uint32_t bits;
    std::memcpy(&bits, &value, 4);
    const uint32_t size = bits & 0x7fffffffU;
    const uint32_t small = size < 0x38800000U ? 0U : (size - 0x38000000U) >> 13;
    return static_cast<uint16_t>(small | ((bits >> 16) & 0x8000U));
}

// And back; 0 becomes 3e-5.
inline float full(uint16_t bits) {
    const uint32_t size = (static_cast<uint32_t>(bits & 0x7fff) << 13) + 0x38000000U;
    const uint32_t all = size | (static_cast<uint32_t>(bits & 0x8000) << 16);
    float value;
    std::memcpy(&value, &all, 4);
    return value;
}

struct Span {
    float frames, whole, middle, jitter;  // frames looked at, of the window, and its middle from the first looked at
};

SPIKED_CLONES void measure_pixels(const uint16_t* __restrict spikes, const uint16_t* __restrict start,
                                  const uint16_t* __restrict stop, int64_t count, Span span, float* __restrict rate,
                                  float* __restrict deviation, uint16_t* __restrict delay,
                                  uint16_t* __restrict duration) {
    const float per_frame = 1 / span.frames;
    for (int64_t i = 0; i < count; ++i) {
        const bool valid = spikes[i] > 0;
        const float first = start[i], last = stop[i], m = spikes[i];
        const float bound = (start[i] != kNever ? 2.0f : 1.0f) * per_frame;
        const float time = valid ? last - first : 1.0f;
        const float per_time = 1 / time, p = m * per_time;
        const float charge = p * p / 6 + span.jitter * m + (0.01f * m) * (0.01f * m);
        const float noise = std::sqrt(charge) * per_time;
        const uint16_t late = half(0.5f * (first + last) + 0.5f - span.middle);
        rate[i] = valid ? p : 0.5f * bound;
        deviation[i] = valid ? noise : bound;
        delay[i] = valid ? late : 0;
        duration[i] = half(valid ? time : span.whole);
    }
}

using Counts = Array<const uint16_t, 2>;
using Image = Array<float, 2>;
using Halves = Array<uint16_t, 2>;

template <class A, class B>
void same_shape(const A& a, const B& b) {
    if (a.shape(0) != b.shape(0) || a.shape(1) != b.shape(1)) {
        throw std::invalid_argument("all images must have the same size");
    }
}

void measure(const Counts& spikes, const Counts& start, const Counts& stop, int frames, int whole, double middle,
             double jitter, const Image& rate, const Image& deviation, const Halves& delay, const Halves& duration) {
    same_shape(spikes, start);
    same_shape(spikes, stop);
    same_shape(spikes, rate);
    same_shape(spikes, deviation);
    same_shape(spikes, delay);
    same_shape(spikes, duration);
    if (frames < 1 || whole < 1) throw std::invalid_argument("a window has at least one frame");
    const Span span = {static_cast<float>(frames), static_cast<float>(whole), static_cast<float>(middle),
                       static_cast<float>(jitter)};
    nb::gil_scoped_release release;
    measure_pixels(spikes.data(), start.data(), stop.data(), static_cast<int64_t>(spikes.size()), span, rate.data(),
                   deviation.data(), delay.data(), duration.data());
}

// The value below which so large a share of an image's values (none negative) are: those in the same of 8,192 steps,
// the upper bits of a float, are told apart, no others.
constexpr int kBinShift = 19;

double quantile(const Array<const float, 2>& image, double share) {
    const size_t count = image.size();
    if (count == 0 || !(share >= 0 && share <= 1))
        throw std::invalid_argument("expected pixels, and a share of 0 to 1");
    const auto step = [](float value) {
        uint32_t bits;
        const float positive = value > 0 ? value : 0.0f;
        std::memcpy(&bits, &positive, 4);
        return bits >> kBinShift;
    };
    nb::gil_scoped_release release;
    std::vector<uint32_t> bins(1 << (32 - kBinShift));
    for (size_t i = 0; i < count; ++i) ++bins[step(image.data()[i])];
    const auto wanted = static_cast<size_t>(share * static_cast<double>(count - 1));
    size_t below = 0;
    uint32_t bin = 0;
    while (below + bins[bin] <= wanted) below += bins[bin++];
    std::vector<float> same;
    same.reserve(bins[bin]);
    for (size_t i = 0; i < count; ++i) {
        if (step(image.data()[i]) == bin) same.push_back(image.data()[i]);
    }
    const auto at = same.begin() + static_cast<int64_t>(wanted - below);
    std::nth_element(same.begin(), at, same.end());
    return *at;
}

constexpr int kBlur = 3;  // px on either side that a Gaussian of 0.8 px is cut at
using Taps = float[kBlur + 1];

// 255 times the root of rate * scale, with `kBlur` px on either side mirrored about the edge, blurred along the row.
SPIKED_CLONES void blurred_row(const float* __restrict rate, int64_t width, float scale, const Taps& taps,
                               float* __restrict line, float* __restrict out) {
    float* row = line + kBlur;
    for (int64_t x = 0; x < width; ++x) row[x] = 255 * std::sqrt(std::min(std::max(rate[x] * scale, 0.0f), 1.0f));
    for (int x = 1; x <= kBlur; ++x) {
        row[-x] = row[x];
        row[width - 1 + x] = row[width - 1 - x];
    }
    for (int64_t x = 0; x < width; ++x) {
        out[x] = taps[0] * row[x] + taps[1] * (row[x - 1] + row[x + 1]) + taps[2] * (row[x - 2] + row[x + 2]) +
                 taps[3] * (row[x - 3] + row[x + 3]);
    }
}

SPIKED_CLONES void blurred_column(const float* const* rows, int64_t width, const Taps& taps, uint8_t* __restrict out) {
    const float *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4], *f = rows[5], *g = rows[6];
    for (int64_t x = 0; x < width; ++x) {
        const float value =
            taps[0] * d[x] + taps[1] * (c[x] + e[x]) + taps[2] * (b[x] + f[x]) + taps[3] * (a[x] + g[x]);
        out[x] = static_cast<uint8_t>(static_cast<int>(value + 0.5f));
    }
}

void picture(const Array<const float, 2>& rate, double white, const Array<uint8_t, 2>& out) {
    same_shape(rate, out);
    const auto height = static_cast<int64_t>(rate.shape(0)), width = static_cast<int64_t>(rate.shape(1));
    if (height <= kBlur || width <= kBlur || !(white > 0)) {
        throw std::invalid_argument("expected a picture of 4x4 pixels or more, and a positive white");
    }
    Taps taps;
    float sum = 0;
    for (int i = 0; i <= kBlur; ++i) {
        taps[i] = std::exp(-0.5f * static_cast<float>(i * i) / (0.8f * 0.8f));
        sum += (i ? 2 : 1) * taps[i];
    }
    for (float& tap : taps) tap /= sum;
    nb::gil_scoped_release release;
    constexpr int64_t kRows = 2 * kBlur + 1;
    std::vector<float> rows(kRows * width), line(width + 2 * kBlur);  // row y is in place y modulo kRows
    int64_t done = 0;
    for (int64_t y = 0; y < height; ++y) {
        for (; done < std::min(y + kBlur + 1, height); ++done) {
            blurred_row(rate.data() + done * width, width, static_cast<float>(1 / white), taps, line.data(),
                        rows.data() + done % kRows * width);
        }
        const float* around[kRows];
        for (int64_t i = -kBlur; i <= kBlur; ++i) {
            const int64_t at = y + i < 0 ? -(y + i) : y + i < height ? y + i : 2 * (height - 1) - (y + i);
            around[i + kBlur] = rows.data() + at % kRows * width;
        }
        blurred_column(around, width, taps, out.data() + y * width);
    }
}

// The mean delay in a window, of rows [top, bottom) and `columns` columns from `left` on, weighed by squared slopes.
template <int kLanes>
inline float steep(const uint8_t* picture, const uint16_t* delay, int64_t stride, int64_t top, int64_t bottom,
                   int columns) {
    float sum[kColumns] = {}, weights[kColumns] = {};
    const int lanes = kLanes ? kLanes : columns;
    for (int64_t y = top; y < bottom; ++y) {
        const uint8_t* q = picture + y * stride;
        const uint8_t *p = q - stride, *r = q + stride;
        const uint16_t* d = delay + y * stride;
#pragma GCC unroll 1
        for (int x = 0; x < lanes; ++x) {
            const int dx = 3 * (p[x + 1] - p[x - 1] + r[x + 1] - r[x - 1]) + 10 * (q[x + 1] - q[x - 1]);
            const int dy = 3 * (r[x - 1] - p[x - 1] + r[x + 1] - p[x + 1]) + 10 * (r[x] - p[x]);
            const float weight = x < columns ? static_cast<float>(dx * dx + dy * dy) + 1 : 0.0f;
            sum[x] += weight * full(d[x]);
            weights[x] += weight;
        }
    }
    float all = 0, weight = 0;
    for (int x = 0; x < lanes; ++x) {
        all += sum[x];
        weight += weights[x];
    }
    return weight > 0 ? all / weight : 0;
}

SPIKED_CLONES float steep_delay(const uint8_t* picture, const uint16_t* delay, int64_t width, int64_t left, int64_t top,
                                int64_t bottom, int columns) {
    return left + kColumns < width ? steep<kColumns>(picture + left, delay + left, width, top, bottom, columns)
                                   : steep<0>(picture + left, delay + left, width, top, bottom, columns);
}

void delays(const Array<const uint8_t, 2>& picture, const Array<const uint16_t, 2>& delay,
            const Array<const double, 2>& at, const Array<double, 1>& out) {
    same_shape(picture, delay);
    if (at.shape(1) != 2 || out.shape(0) != at.shape(0)) throw std::invalid_argument("expected at [n, 2], out [n]");
    const auto height = static_cast<int64_t>(picture.shape(0)), width = static_cast<int64_t>(picture.shape(1));
    if (height < 3 || width < 3) throw std::invalid_argument("a picture needs 3x3 pixels");
    for (size_t n = 0; n < at.shape(0); ++n) {
        const auto x = static_cast<int64_t>(std::clamp(at.data()[2 * n], 0.0, static_cast<double>(width - 1)));
        const auto y = static_cast<int64_t>(std::clamp(at.data()[2 * n + 1], 0.0, static_cast<double>(height - 1)));
        const int64_t left = std::clamp<int64_t>(x - kReach, 1, width - 2);
        const int64_t right = std::clamp<int64_t>(x + kReach + 1, left + 1, width - 1);
        const int64_t top = std::clamp<int64_t>(y - kReach, 1, height - 2);
        const int64_t bottom = std::clamp<int64_t>(y + kReach + 1, top + 1, height - 1);
        out.data()[n] =
            steep_delay(picture.data(), delay.data(), width, left, top, bottom, static_cast<int>(right - left));
    }
}

}  // namespace

void bind_light(nb::module_& m) {
    m.def("measure", &measure,
          "Rates and their deviations [H, W], and bits of half floats: frames from `middle` (counted from the first\n"
          "frame looked at) to the middle of each pixel's charge, and over which it came together; `whole` for none.");
    m.def("quantile", &quantile, "The value below which such a share of an image's values are; none may be negative.");
    m.def("picture", &picture, "255 times the root of rate / white, at most 255, blurred by 0.8 px.");
    m.def("delays", &delays,
          "Mean of `delay` (bits of half floats) in the 13x13 pixels around each place, weighed by squared slopes.");
}

}  // namespace spiked
