// From spike intervals to images: rates, their noise, and the times of the intervals.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr int kReach = 6;  // px from the middle of a track's window to its edge
constexpr int kColumns = 16;

// The spike interval of each pixel, as spiked.recon.frontend.spike_intervals.SpikeIntervals.
template <class T>
struct Intervals {
    const T *spikes, *start, *stop;
    int64_t count;
};

template <class T>
using Offsets = Array<const T, 2>;
using Image = Array<float, 2>;

template <class A, class B>
void expect_same_shape(const A& a, const B& b) {
    if (a.shape(0) != b.shape(0) || a.shape(1) != b.shape(1)) {
        throw std::invalid_argument("all images must have the same size");
    }
}

template <class T>
Intervals<T> intervals_of(const Offsets<T>& spikes, const Offsets<T>& start, const Offsets<T>& stop) {
    expect_same_shape(spikes, start);
    expect_same_shape(spikes, stop);
    return {spikes.data(), start.data(), stop.data(), static_cast<int64_t>(spikes.size())};
}

constexpr uint8_t kByte = 0xFF;  // the largest number of a byte; all of them are "never"
constexpr uint16_t kWord = 0xFFFF;
// Relative error of the scale of a charge, which does not fall with the number of spikes.
constexpr float kChargeError = 0.01f;

// Where no interval was seen there is a spike or none in all frames read. As half of the bounds; or so that the mean
// over windows that begin anywhere between two spikes is the rate. A spike is alone if D = 1 / rate exceeds its
// distance d to the farther end of the n frames: its rate is n / (2 d^2), because the mean of that from n / 2 to D is 1
// / D.
template <class T>
SPIKED_INLINE void rate_pixels(Intervals<T> e, T never, float frames, bool unbiased, float* __restrict out) {
    const float per_frame = 1 / frames, silent = unbiased ? 0.0f : 0.5f * per_frame;
    for (int64_t i = 0; i < e.count; ++i) {
        const float m = e.spikes[i], time = static_cast<float>(e.stop[i] - e.start[i]);
        const float at = static_cast<float>(e.start[i]) + 0.5f, far = std::max(at, frames - at);
        const float alone = unbiased ? 0.5f * frames / (far * far) : per_frame;
        out[i] = m > 0 ? m / time : e.start[i] != never ? alone : silent;
    }
}

template <class T>
SPIKED_INLINE void deviation_pixels(Intervals<T> e, float per_frame, float jitter, float* __restrict out) {
    for (int64_t i = 0; i < e.count; ++i) {
        const float m = e.spikes[i], per_time = 1 / std::max(static_cast<float>(e.stop[i] - e.start[i]), 1.0f);
        const float p = m * per_time;
        // Both spikes are known to the frame: twice the variance 1/12 of a uniform distribution.
        const float charge = p * p / 6 + jitter * m + (kChargeError * m) * (kChargeError * m);
        out[i] = m > 0 ? std::sqrt(charge) * per_time : per_frame;
    }
}

template <class T>
SPIKED_INLINE void time_pixels(Intervals<T> e, float middle, float half, float* __restrict first,
                               float* __restrict last) {
    for (int64_t i = 0; i < e.count; ++i) {
        first[i] = e.spikes[i] > 0 ? static_cast<float>(e.start[i]) + 0.5f - middle : -half;
        last[i] = e.spikes[i] > 0 ? static_cast<float>(e.stop[i]) + 0.5f - middle : half;
    }
}

SPIKED_CLONES void rate_all(Intervals<uint8_t> e, float frames, bool unbiased, float* out) {
    rate_pixels(e, kByte, frames, unbiased, out);
}
SPIKED_CLONES void rate_all(Intervals<uint16_t> e, float frames, bool unbiased, float* out) {
    rate_pixels(e, kWord, frames, unbiased, out);
}
SPIKED_CLONES void deviation_all(Intervals<uint8_t> e, float per_frame, float jitter, float* out) {
    deviation_pixels(e, per_frame, jitter, out);
}
SPIKED_CLONES void deviation_all(Intervals<uint16_t> e, float per_frame, float jitter, float* out) {
    deviation_pixels(e, per_frame, jitter, out);
}
SPIKED_CLONES void time_all(Intervals<uint8_t> e, float middle, float half, float* first, float* last) {
    time_pixels(e, middle, half, first, last);
}
SPIKED_CLONES void time_all(Intervals<uint16_t> e, float middle, float half, float* first, float* last) {
    time_pixels(e, middle, half, first, last);
}

float at_least_one(int frames) {
    if (frames < 1) throw std::invalid_argument("a window has at least one frame");
    return static_cast<float>(frames);
}

template <class T>
void rates(const Offsets<T>& spikes, const Offsets<T>& start, const Offsets<T>& stop, int frames, bool unbiased,
           const Image& out) {
    expect_same_shape(spikes, out);
    const float read = at_least_one(frames);
    const auto intervals = intervals_of<T>(spikes, start, stop);
    nb::gil_scoped_release release;
    rate_all(intervals, read, unbiased, out.data());
}

template <class T>
void deviations(const Offsets<T>& spikes, const Offsets<T>& start, const Offsets<T>& stop, int frames, double jitter,
                const Image& out) {
    expect_same_shape(spikes, out);
    const float share = 1 / at_least_one(frames);
    const auto intervals = intervals_of<T>(spikes, start, stop);
    nb::gil_scoped_release release;
    deviation_all(intervals, share, static_cast<float>(jitter), out.data());
}

template <class T>
void times(const Offsets<T>& spikes, const Offsets<T>& start, const Offsets<T>& stop, double middle, double length,
           const Image& first, const Image& last) {
    expect_same_shape(spikes, first);
    expect_same_shape(spikes, last);
    const auto intervals = intervals_of<T>(spikes, start, stop);
    nb::gil_scoped_release release;
    time_all(intervals, static_cast<float>(middle), static_cast<float>(length / 2), first.data(), last.data());
}

// The quantile `share` of the values of an image, none of them negative. A histogram of 8,192 bins, the upper bits of a
// float, finds the bin; only the values of that bin are sorted.
constexpr int kBinShift = 19;

double quantile(const nb::ndarray<const float, nb::ndim<2>, nb::device::cpu>& image, double share) {
    const auto height = static_cast<int64_t>(image.shape(0)), width = static_cast<int64_t>(image.shape(1));
    if (height == 0 || width == 0 || !(share >= 0 && share <= 1))
        throw std::invalid_argument("expected pixels, and a share of 0 to 1");
    const auto step = [](float value) {
        uint32_t bits;
        std::memcpy(&bits, &value, 4);
        return bits >> kBinShift;
    };
    nb::gil_scoped_release release;
    std::vector<uint32_t> bins(1 << (32 - kBinShift));
    std::vector<float> values(height * width), same;
    for (int64_t y = 0, i = 0; y < height; ++y) {
        const float* row = image.data() + y * image.stride(0);
        for (int64_t x = 0; x < width; ++x) {
            const float value = row[x * image.stride(1)];
            values[i++] = value > 0 ? value : 0.0f;
        }
    }
    for (const float value : values) ++bins[step(value)];
    const auto wanted = static_cast<size_t>(share * static_cast<double>(values.size() - 1));
    size_t below = 0;
    uint32_t bin = 0;
    while (below + bins[bin] <= wanted) below += bins[bin++];
    same.reserve(bins[bin]);
    for (const float value : values) {
        if (step(value) == bin) same.push_back(value);
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
    expect_same_shape(rate, out);
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

// Twice the mean middle of the intervals in rows [top, bottom) and `columns` columns, weighted by squared slopes, minus
// `twice` the middle of the window (frames).
template <int kLanes, class T>
SPIKED_INLINE float weighted_time(const uint8_t* picture, Intervals<T> intervals, int64_t stride, int64_t top,
                                  int64_t bottom, int columns, float twice) {
    float sum[kColumns] = {}, weights[kColumns] = {};
    const int lanes = kLanes ? kLanes : columns;
    for (int64_t y = top; y < bottom; ++y) {
        const uint8_t* q = picture + y * stride;
        const uint8_t *p = q - stride, *r = q + stride;
        const T *m = intervals.spikes + y * stride, *first = intervals.start + y * stride,
                *last = intervals.stop + y * stride;
        float weight[kColumns], late[kColumns];
        SPIKED_LANES for (int x = 0; x < lanes; ++x) {
            const int dx = 3 * (p[x + 1] - p[x - 1] + r[x + 1] - r[x - 1]) + 10 * (q[x + 1] - q[x - 1]);
            const int dy = 3 * (r[x - 1] - p[x - 1] + r[x + 1] - p[x + 1]) + 10 * (r[x] - p[x]);
            weight[x] = x < columns ? static_cast<float>(dx * dx + dy * dy + 1) : 0.0f;
        }
        SPIKED_LANES for (int x = 0; x < lanes; ++x) {
            const int sure = m[x] > 0 ? 1 : 0;
            late[x] = static_cast<float>(sure * (first[x] + last[x])) - static_cast<float>(sure) * twice;
        }
        SPIKED_LANES for (int x = 0; x < lanes; ++x) {
            sum[x] += weight[x] * late[x];
            weights[x] += weight[x];
        }
    }
    float all = 0, weight = 0;
    for (int x = 0; x < lanes; ++x) {
        all += sum[x];
        weight += weights[x];
    }
    return weight > 0 ? all / weight : 0;
}

template <class T>
SPIKED_INLINE float weighted_time_any(const uint8_t* picture, Intervals<T> intervals, int64_t width, int64_t left,
                                      int64_t top, int64_t bottom, int columns, float twice) {
    intervals.spikes += left;
    intervals.start += left;
    intervals.stop += left;
    return left + kColumns < width
               ? weighted_time<kColumns>(picture + left, intervals, width, top, bottom, columns, twice)
               : weighted_time<0>(picture + left, intervals, width, top, bottom, columns, twice);
}

SPIKED_CLONES float weighted_time_clones(const uint8_t* picture, Intervals<uint8_t> intervals, int64_t width,
                                         int64_t left, int64_t top, int64_t bottom, int columns, float twice) {
    return weighted_time_any(picture, intervals, width, left, top, bottom, columns, twice);
}
SPIKED_CLONES float weighted_time_clones(const uint8_t* picture, Intervals<uint16_t> intervals, int64_t width,
                                         int64_t left, int64_t top, int64_t bottom, int columns, float twice) {
    return weighted_time_any(picture, intervals, width, left, top, bottom, columns, twice);
}

template <class T>
void delays(const Array<const uint8_t, 2>& picture, const Offsets<T>& spikes, const Offsets<T>& start,
            const Offsets<T>& stop, double middle, const Array<const double, 2>& at, const Array<double, 1>& out) {
    expect_same_shape(picture, spikes);
    const auto intervals = intervals_of<T>(spikes, start, stop);
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
        out.data()[n] = 0.5 * weighted_time_clones(picture.data(), intervals, width, left, top, bottom,
                                                   static_cast<int>(right - left), static_cast<float>(2 * middle - 1));
    }
}

// When pixels look, in sub-frames from `first` on: within [0, parts], at least `least` long. seen: whether that is
// `share` of the time or more.
SPIKED_CLONES void exposures_clones(const float* start, const float* stop, int64_t count, float first, float scale,
                                    float parts, float least, float share, float* begin, float* end, uint8_t* seen) {
    for (int64_t i = 0; i < count; ++i) {
        const float from = (start[i] - first) * scale, to = (stop[i] - first) * scale;
        const float low = std::min(std::max(from, 0.0f), parts - least);
        const float high = std::min(std::max(to, low + least), parts);
        begin[i] = low;
        end[i] = high;
        seen[i] = high - low >= share * (to - from);
    }
}

void exposures(const Array<const float, 2>& start, const Array<const float, 2>& stop, float first, float scale,
               float parts, float least, float share, const Array<float, 3>& windows, const Array<uint8_t, 2>& seen) {
    expect_same_shape(start, stop);
    expect_same_shape(start, seen);
    const auto count = static_cast<int64_t>(start.size());
    if (windows.shape(0) != 2 || static_cast<int64_t>(windows.size()) != 2 * count)
        throw std::invalid_argument("expected windows [2, H, W]");
    exposures_clones(start.data(), stop.data(), count, first, scale, parts, least, share, windows.data(),
                     windows.data() + count, seen.data());
}

// Bindings for bytes and for words. Arrays are not converted, or all would be taken for bytes.
template <class T>
void bind_intervals(nb::module_& m) {
    const auto spikes = nb::arg("spikes").noconvert(), start = nb::arg("start").noconvert();
    const auto stop = nb::arg("stop").noconvert(), out = nb::arg("out").noconvert();
    m.def("rates", &rates<T>, spikes, start, stop, nb::arg("frames"), nb::arg("unbiased"), out,
          "Spikes a frame. Without an interval half of their upper bound, or what is right in the mean of windows.");
    m.def("deviations", &deviations<T>, spikes, start, stop, nb::arg("frames"), nb::arg("jitter"), out,
          "Standard deviations of rates; that of one spike in all frames read where no interval was seen.");
    m.def("times", &times<T>, spikes, start, stop, nb::arg("middle"), nb::arg("length"), nb::arg("first").noconvert(),
          nb::arg("last").noconvert(),
          "Frames from `middle` to the first and to the last spike of each pixel's interval.");
    m.def("delays", &delays<T>, nb::arg("picture"), spikes, start, stop, nb::arg("middle"), nb::arg("at"), out,
          "Mean frames from `middle` to the middles of the intervals of the 13x13 pixels around each position,\n"
          "weighted by squared slopes.");
}

}  // namespace

void bind_rates(nb::module_& m) {
    bind_intervals<uint8_t>(m);
    bind_intervals<uint16_t>(m);
    m.def("exposures", &exposures, nb::arg("start"), nb::arg("stop"), nb::arg("first"), nb::arg("scale"),
          nb::arg("parts"), nb::arg("least"), nb::arg("share"), nb::arg("windows").noconvert(),
          nb::arg("seen").noconvert(), "When pixels look, in sub-frames, and whether that is most of their time.");
    m.def("quantile", &quantile, "The quantile `share` of an image's values; none may be negative.");
    m.def("picture", &picture, nb::arg("rate"), nb::arg("white"), nb::arg("out").noconvert(),
          "255 sqrt(rate / white), at most 255, blurred by a Gaussian of 0.8 px.");
}

}  // namespace spiked
