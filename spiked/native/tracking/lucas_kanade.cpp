// Pyramidal Lucas-Kanade with a forward-backward check.
// (J.-Y. Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000: the gradients are those of the
// first image, so that one matrix serves all iterations.)
#include <nanobind/stl/vector.h>

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

constexpr int kWindow = 13;  // px
constexpr float kHalf = 0.5f * (kWindow - 1);
constexpr int kLanes = 16;
constexpr int kPatch = kWindow + 2;  // with a border for the gradients
constexpr int kIterations = 30;
constexpr float kConverged2 = 0.003f * 0.003f;  // px^2, the search ends at a smaller step
constexpr float kNear2 = 0.3f * 0.3f;           // px^2, the first part of the search ends at a smaller step
constexpr float kTurn2 = 0.05f * 0.05f;         // rad^2 and relative scale^2: typical rotation and growth of a window
constexpr float kLeastEdge = 0.1f;  // mean squared gradient a px across the weakest direction, in grey levels squared

constexpr int kMargin = 24;  // px around an image that repeat its edge

// An image without its margin; a position may lie half a window beyond the edge.
struct PaddedImage {
    // The row from (x, y) on.
    const float* at(float x, float y) const {
        return data + static_cast<int64_t>(y) * stride + static_cast<int64_t>(x);
    }
    bool holds(float x, float y) const {
        return x >= -kHalf && y >= -kHalf && x < static_cast<float>(width) + kHalf &&
               y < static_cast<float>(height) + kHalf;
    }

    const float* data;
    int width, height;
    int64_t stride;
};

// A row of the window and what fills up a vector.
typedef float Row __attribute__((vector_size(4 * kLanes)));
constexpr Row kInside = {1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1};
constexpr Row kFromMiddle = {-6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9};  // px

struct Window {
    Row value[kWindow], across[kWindow], down[kWindow];
};

struct Matrix {
    float xx, xy, yy;
};

inline Row load(const float* from) {
    Row row;
    std::memcpy(&row, from, sizeof row);
    return row;
}

inline float total(Row row) {
    typedef float Half __attribute__((vector_size(2 * kLanes)));
    typedef float Quarter __attribute__((vector_size(kLanes)));
    Half half[2];
    std::memcpy(half, &row, sizeof half);
    half[0] += half[1];
    Quarter quarter[2];
    std::memcpy(quarter, half, sizeof quarter);
    quarter[0] += quarter[1];
    return (quarter[0][0] + quarter[0][2]) + (quarter[0][1] + quarter[0][3]);
}

// A row interpolated between pixels x and x + 1 with weight `a`.
inline Row interpolated(const float* row, float a) {
    const Row here = load(row);
    return here + a * (load(row + 1) - here);
}

// Calls take(n, row) for `count` rows from (x, y) on, interpolated bilinearly.
template <class Take>
[[gnu::always_inline]] inline void each_row(const PaddedImage& of, float x, float y, int count, const Take& take) {
    const float left = std::floor(x), top = std::floor(y), a = x - left, b = y - top;
    const float* corner = of.at(left, top);
    Row before = interpolated(corner, a);
    for (int n = 0; n < count; ++n) {
        const Row after = interpolated(corner + (n + 1) * of.stride, a);
        take(n, before + b * (after - before));
        before = after;
    }
}

// An offset from the middle of a window (x to the right, y down) in the image whose appearance is compared: a linear
// map, row by row.
struct Affine {
    float xx, xy, yx, yy;

    Affine inverse() const {
        const float scale = 1 / (xx * yy - xy * yx);
        return {scale * yy, -scale * xy, -scale * yx, scale * xx};
    }
};

using Patch = float[kPatch][kLanes + 4];

// The patch around (x, y).
[[gnu::always_inline]] inline void sample(const PaddedImage& of, float x, float y, Patch& patch) {
    each_row(of, x - kHalf - 1, y - kHalf - 1, kPatch,
             [&](int n, const Row& row) { std::memcpy(patch[n], &row, sizeof row); });
}

// The patch around (x, y) whose pixel at an offset d is that at offset `warp` d of the image, interpolated bilinearly.
[[gnu::always_inline]] inline void sample_warped(const PaddedImage& of, float x, float y, const Affine& warp,
                                                 Patch& patch) {
    const auto low = static_cast<float>(-kMargin), right = static_cast<float>(of.width + kMargin - 2),
               bottom = static_cast<float>(of.height + kMargin - 2);
    for (int row = 0; row < kPatch; ++row) {
        const float v = static_cast<float>(row) - kHalf - 1;
        for (int column = 0; column < kPatch; ++column) {
            const float u = static_cast<float>(column) - kHalf - 1;
            const float at_x = std::clamp(x + warp.xx * u + warp.xy * v, low, right);
            const float at_y = std::clamp(y + warp.yx * u + warp.yy * v, low, bottom);
            const float left = std::floor(at_x), top = std::floor(at_y), a = at_x - left, b = at_y - top;
            const float* p = of.at(left, top);
            const float* q = p + of.stride;
            const float above = p[0] + a * (p[1] - p[0]), below = q[0] + a * (q[1] - q[0]);
            patch[row][column] = above + b * (below - above);
        }
    }
}

// The window in the middle of a patch, with its gradients (Scharr), which are 0 beyond its last column.
[[gnu::always_inline]] inline void differentiate(const Patch& patch, Window& window) {
    const Row inside = kInside / 32;
    for (int y = 0; y < kWindow; ++y) {
        const float *p = patch[y], *q = patch[y + 1], *r = patch[y + 2];
        const Row above = load(p), below = load(r), above2 = load(p + 2), below2 = load(r + 2);
        window.value[y] = load(q + 1);
        window.across[y] = inside * (3 * (above2 - above + below2 - below) + 10 * (load(q + 2) - load(q)));
        window.down[y] = inside * (3 * (below - above + below2 - above2) + 10 * (load(r + 1) - load(p + 1)));
    }
}

// The products of the gradients.
inline Matrix products(const Window& window) {
    Row xx = {}, xy = {}, yy = {};
    for (int y = 0; y < kWindow; ++y) {
        xx += window.across[y] * window.across[y];
        xy += window.across[y] * window.down[y];
        yy += window.down[y] * window.down[y];
    }
    return {total(xx), total(xy), total(yy)};
}

// Projects the changes of appearance by brightness, contrast, rotation and scale out of the gradients, so that these
// changes do not bias the displacement (G. D. Hager and P. N. Belhumeur, "Efficient region tracking with parametric
// models of geometry and illumination", 1998). Rotation and scale have a prior: `noise2` is the variance of a pixel in
// grey levels squared.
[[gnu::always_inline]] inline void project_out_appearance(Window& window, float noise2) {
    constexpr int kAppearance = 4, kAll = kAppearance + 2;
    const float middle = window.value[kWindow / 2][kWindow / 2];
    const auto appearance_and_gradients = [&](int y, Row* out) {
        const float v = static_cast<float>(y) - kHalf;
        const Row dx = window.across[y], dy = window.down[y];
        out[0] = kInside;
        out[1] = kInside * (window.value[y] - middle);
        out[2] = dx * v - dy * kFromMiddle;
        out[3] = dx * kFromMiddle + dy * v;
        out[kAppearance] = dx;
        out[kAppearance + 1] = dy;
    };
    Row sums[kAll][kAll] = {};
    for (int y = 0; y < kWindow; ++y) {
        Row row[kAll];
        appearance_and_gradients(y, row);
        for (int i = 0; i < kAll; ++i) {
            for (int k = 0; k <= i; ++k) sums[i][k] += row[i] * row[k];
        }
    }
    float product[kAll][kAll], least[kAppearance], share[2][kAppearance] = {};
    for (int i = 0; i < kAll; ++i) {
        for (int k = 0; k <= i; ++k) product[i][k] = product[k][i] = total(sums[i][k]);
    }
    for (int n = 0; n < kAppearance; ++n) least[n] = 1e-5f * product[n][n];
    product[2][2] += noise2 / kTurn2;
    product[3][3] += noise2 / kTurn2;
    const auto counts = [&](int n) { return product[n][n] > least[n]; };  // independent of those before it
    for (int n = 0; n < kAppearance; ++n) {
        for (int i = 0; counts(n) && i < kAll; ++i) {
            const float factor = i == n ? 0.0f : product[i][n] / product[n][n];
            for (int k = n + 1; k < kAll; ++k) product[i][k] -= factor * product[n][k];
        }
    }
    for (int n = 0; n < kAppearance; ++n) {
        for (int g = 0; counts(n) && g < 2; ++g) share[g][n] = product[n][kAppearance + g] / product[n][n];
    }
    for (int y = 0; y < kWindow; ++y) {
        Row row[kAll];
        appearance_and_gradients(y, row);
        for (int n = 0; n < kAppearance; ++n) {
            window.across[y] -= share[0][n] * row[n];
            window.down[y] -= share[1][n] * row[n];
        }
    }
}

// Sums over the window of its gradients times the difference to another image at (u, v).
[[gnu::always_inline]] inline void differ(const Window& window, const PaddedImage& to, float u, float v, float* across,
                                          float* down) {
    Row by_across = {}, by_down = {};
    each_row(to, u - kHalf, v - kHalf, kWindow, [&](int n, const Row& row) {
        const Row difference = row - window.value[n];
        by_across += difference * window.across[n];
        by_down += difference * window.down[n];
    });
    *across = total(by_across);
    *down = total(by_down);
}

// The variance over a window of that difference.
[[gnu::always_inline]] inline float difference2(const Window& window, const PaddedImage& to, float u, float v) {
    Row sum = {}, square = {};
    each_row(to, u - kHalf, v - kHalf, kWindow, [&](int n, const Row& row) {
        const Row difference = kInside * (row - window.value[n]);
        sum += difference;
        square += difference * difference;
    });
    constexpr float kShare = 1.0f / (kWindow * kWindow);
    const float mean = kShare * total(sum);
    return std::max(kShare * total(square) - mean * mean, 0.0f);
}

// Moves (*u, *v) to the position of a window in `to`, by steps until one is smaller than sqrt(last2). Returns whether
// it was found.
SPIKED_INLINE bool iterate(const Window& window, const PaddedImage& to, float last2, float* u, float* v) {
    const Matrix g = products(window);
    const float spread = std::sqrt((g.xx - g.yy) * (g.xx - g.yy) + 4 * g.xy * g.xy);
    if (g.xx + g.yy - spread < 2 * kLeastEdge * kWindow * kWindow) return false;
    const float scale = 1 / (g.xx * g.yy - g.xy * g.xy);
    for (int n = 0; n < kIterations; ++n) {
        if (!to.holds(*u, *v)) return false;
        float across, down;
        differ(window, to, *u, *v, &across, &down);
        const float du = (g.xy * down - g.yy * across) * scale, dv = (g.xy * across - g.xx * down) * scale;
        *u += du;
        *v += dv;
        if (du * du + dv * dv <= last2) break;
    }
    return to.holds(*u, *v);
}

// Moves (*u, *v) to the position in `to` of the window around (x, y) of `from`, warped if there is a `warp`; returns
// whether it was found. Appearance is projected out at the end only: without it, the basin of convergence is wider.
SPIKED_CLONES bool align(const PaddedImage& from, const PaddedImage& to, float x, float y, const Affine* warp,
                         bool exactly, float* u, float* v) {
    if (!from.holds(x, y)) return false;
    Patch patch = {};
    if (warp == nullptr) {
        sample(from, x, y, patch);
    } else {
        sample_warped(from, x, y, *warp, patch);
    }
    Window window;
    differentiate(patch, window);
    if (!iterate(window, to, exactly ? kNear2 : kConverged2, u, v)) return false;
    if (!exactly) return true;
    project_out_appearance(window, difference2(window, to, *u, *v));
    return iterate(window, to, kConverged2, u, v);
}

using Images = std::vector<Array<const float, 2>>;

std::vector<PaddedImage> padded_images(const Images& images) {
    std::vector<PaddedImage> out;
    for (const auto& one : images) {
        if (one.shape(0) <= 2 * kMargin || one.shape(1) <= 2 * kMargin) {
            throw std::invalid_argument("an image has no pixels within its margin");
        }
        const auto stride = static_cast<int64_t>(one.shape(1));
        out.push_back({one.data() + kMargin * stride + kMargin, static_cast<int>(stride) - 2 * kMargin,
                       static_cast<int>(one.shape(0)) - 2 * kMargin, stride});
    }
    return out;
}

// From the smallest image to the full one; (x, y) and (*u, *v) are in px of that, pixel centres at whole numbers.
bool track_pyramid(const std::vector<PaddedImage>& from, const std::vector<PaddedImage>& to, float x, float y, float* u,
                   float* v) {
    bool found = false;
    for (int level = static_cast<int>(from.size()) - 1; level >= 0; --level) {
        const float scale = 1.0f / static_cast<float>(1 << level);
        float at_u = *u * scale, at_v = *v * scale;
        found = align(from[level], to[level], x * scale, y * scale, nullptr, level == 0, &at_u, &at_v);
        *u = at_u / scale;
        *v = at_v / scale;
    }
    return found;
}

// Copies an image as floats, with the margin.
void pad(const Array<const uint8_t, 2>& image, const Array<float, 2>& out) {
    const auto height = static_cast<int64_t>(image.shape(0)), width = static_cast<int64_t>(image.shape(1));
    if (height == 0 || width == 0 || out.shape(0) != image.shape(0) + 2 * kMargin ||
        out.shape(1) != image.shape(1) + 2 * kMargin) {
        throw std::invalid_argument("expected an image [H, W], and out with MARGIN_PX more on each side");
    }
    const int64_t stride = width + 2 * kMargin;
    float* first = out.data() + kMargin * stride;
    for (int64_t y = 0; y < height; ++y) {
        const uint8_t* from = image.data() + y * width;
        float* to = first + y * stride;
        std::fill_n(to, kMargin, static_cast<float>(from[0]));
        std::copy_n(from, width, to + kMargin);
        std::fill_n(to + kMargin + width, kMargin, static_cast<float>(from[width - 1]));
    }
    for (int64_t y = 0; y < kMargin; ++y) {
        std::copy_n(first, stride, out.data() + y * stride);
        std::copy_n(first + (height - 1) * stride, stride, first + (height + y) * stride);
    }
}

// `back`: also require that the track comes back (forward-backward check).
void track(const Images& a, const Images& b, const Array<const double, 2>& start, const Array<double, 2>& at,
           float reach, bool back, const Array<bool, 1>& good) {
    const size_t count = start.shape(0);
    if (a.empty() || a.size() != b.size() || a.size() > 16) {
        throw std::invalid_argument("expected as many levels, 1 to 16, of both images");
    }
    if (start.shape(1) != 2 || at.shape(0) != count || at.shape(1) != 2 || good.shape(0) != count) {
        throw std::invalid_argument("expected start and at [n, 2], good [n]");
    }
    const std::vector<PaddedImage> first = padded_images(a), second = padded_images(b);
    for (size_t i = 0; i < first.size(); ++i) {
        if (first[i].width != second[i].width || first[i].height != second[i].height) {
            throw std::invalid_argument("both images must have the same size");
        }
    }
    nb::gil_scoped_release release;
    for (size_t n = 0; n < count; ++n) {
        const float x = static_cast<float>(start.data()[2 * n] - 0.5);
        const float y = static_cast<float>(start.data()[2 * n + 1] - 0.5);
        float u = static_cast<float>(at.data()[2 * n] - 0.5), v = static_cast<float>(at.data()[2 * n + 1] - 0.5);
        bool found = track_pyramid(first, second, x, y, &u, &v);
        at.data()[2 * n] = u + 0.5;
        at.data()[2 * n + 1] = v + 0.5;
        if (found && back) {
            float back_x = x, back_y = y;
            found = track_pyramid(second, first, u, v, &back_x, &back_y) && std::hypot(back_x - x, back_y - y) < reach;
        }
        good.data()[n] = found;
    }
}

// Aligns each track between its own image of `births` and the newest one, at full size.
void refine_tracks(const Images& births, const Array<const int64_t, 1>& birth, const Array<const float, 2>& newest,
                   const Array<const double, 2>& start, const Array<const float, 3>& warps, const Array<double, 2>& at,
                   float reach, float near, const Array<bool, 1>& good) {
    const size_t count = start.shape(0);
    const bool warped = warps.shape(0) > 0;
    if (birth.shape(0) != count || start.shape(1) != 2 || at.shape(0) != count || at.shape(1) != 2 ||
        good.shape(0) != count) {
        throw std::invalid_argument("expected birth [n], start and at [n, 2], good [n]");
    }
    if ((warped && warps.shape(0) != count) || warps.shape(1) != 2 || warps.shape(2) != 2) {
        throw std::invalid_argument("expected warps [n, 2, 2] or [0, 2, 2]");
    }
    const std::vector<PaddedImage> from = padded_images(births), to = padded_images({newest});
    for (const PaddedImage& one : from) {
        if (one.width != to[0].width || one.height != to[0].height) {
            throw std::invalid_argument("all images must have the same size");
        }
    }
    for (size_t n = 0; n < count; ++n) {
        if (birth.data()[n] < 0 || birth.data()[n] >= static_cast<int64_t>(from.size())) {
            throw std::invalid_argument("a track names an image that does not exist");
        }
    }
    nb::gil_scoped_release release;
    for (size_t n = 0; n < count; ++n) {
        const PaddedImage& born = from[birth.data()[n]];
        const auto x = static_cast<float>(start.data()[2 * n] - 0.5);
        const auto y = static_cast<float>(start.data()[2 * n + 1] - 0.5);
        const auto guess_u = static_cast<float>(at.data()[2 * n] - 0.5);
        const auto guess_v = static_cast<float>(at.data()[2 * n + 1] - 0.5);
        float u = guess_u, v = guess_v, back_x = x, back_y = y;
        Affine onto = {}, from_birth = {};
        if (warped) {
            const float* w = warps.data() + 4 * n;
            onto = {w[0], w[1], w[2], w[3]};
            from_birth = onto.inverse();
        }
        good.data()[n] = align(born, to[0], x, y, warped ? &from_birth : nullptr, true, &u, &v) &&
                         std::hypot(u - guess_u, v - guess_v) < near &&
                         align(to[0], born, u, v, warped ? &onto : nullptr, true, &back_x, &back_y) &&
                         std::hypot(back_x - x, back_y - y) < reach;
        at.data()[2 * n] = u + 0.5;
        at.data()[2 * n + 1] = v + 0.5;
    }
}

}  // namespace

void bind_lucas_kanade(nb::module_& m) {
    m.attr("MARGIN_PX") = kMargin;
    m.def("pad", &pad, "Copies an image [H, W] to floats, with MARGIN_PX around it that repeat its edge.");
    m.def(
        "track", &track, nb::arg("a"), nb::arg("b"), nb::arg("start"), nb::arg("at").noconvert(), nb::arg("reach"),
        nb::arg("back"), nb::arg("good").noconvert(),
        "Tracks the positions `start` [n, 2] from pyramid `a` to pyramid `b`, whose levels are half the size of the "
        "one\n"
        "before, padded by `pad`. `at` [n, 2] holds guesses and gets the result. `good` [n]: found and, with `back`,\n"
        "less than `reach` px from the start when tracked back. Pixel centres are at +0.5.");
    m.def("refine_tracks", &refine_tracks, nb::arg("births"), nb::arg("birth"), nb::arg("newest"), nb::arg("start"),
          nb::arg("warps"), nb::arg("at").noconvert(), nb::arg("reach"), nb::arg("near"), nb::arg("good").noconvert(),
          "Tracks the positions `start` [n, 2] from image `birth` [n] of `births` to `newest`. `at` [n, 2] holds "
          "guesses\n"
          "and gets the result. `warps` [n, 2, 2], invertible, or [0, 2, 2]: how offsets from a position of the birth\n"
          "image appear in the newest. `good` [n]: found less than `near` px from the guess and, tracked back, less "
          "than\n"
          "`reach` px from the start.");
}

}  // namespace spiked
