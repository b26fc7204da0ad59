// The kernels that compare an image with a view's rates, see RateLoss in spiked/recon/mapping/loss.py, and gather what
// they tell of the pixels' gains. A value of the image a thread.

namespace spiked {
namespace {

constexpr int kValueThreads = 256;  // of kernels with a value of an image a thread
enum CompareSum { kSquares, kExpectedLight, kObservedLight, kCompareSums = 4 };  // warps add up powers of two

// An image and the view that it is compared with, [height][width][colours].
struct Compared {
    int width, height, colours;  // one of a grey image and of a mosaic
    int64_t values;
    bool mosaic;
    const float *rendered, *rates, *deviation;
    const float* gain;  // [height][width] of one colour; null: 1

    SPIKED_DEVICE float factor(int64_t at, float level) const { return gain ? gain[at] * level : 1.0f; }
};

// The squared error, weighted by the noise: what is expected of the rates, the slope by it, and a block's sums.
struct CompareRates {
    static constexpr int kThreads = kValueThreads;
    Compared image;
    RateLoss loss;
    float *expected, *slope;
    double* partial;  // [blocks][kCompareSums]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        SPIKED_SHARED double totals[Block<kThreads>::kWarps][kCompareSums];
        PerThread<Sums<double, kCompareSums>, kThreads> sums;
        PerThread<bool, kThreads> some;
        const float floor = loss.floor * loss.white, square = floor * floor;
        const float twice = 2 / (loss.white * loss.white * static_cast<float>(image.values));
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            sums[thread] = {};
            some[thread] = at < image.values;
            if (!some[thread]) return;
            const float rate = image.rates[at], deviation = image.deviation[at];
            expected[at] = image.rendered[at] * image.factor(at, loss.level);
            const float error = expected[at] - rate, weight = square / (deviation * deviation + square);
            slope[at] = twice * weight * error;
            double* sum = sums[thread].of;
            sum[kSquares] = weight * error * error;
            if (!image.gain) return;
            const float light = image.gain[at] * image.rendered[at];
            if (!agrees(light, rate, deviation, loss.model_error, loss.sigmas)) return;
            sum[kExpectedLight] = light;
            sum[kObservedLight] = rate;
        });
        block.sums(sums, some, &totals[0][0], partial + static_cast<int64_t>(block.index) * kCompareSums);
    }
};

// The place of number i among so many, mirrored at both ends as often as needed.
SPIKED_DEVICE inline int mirrored(int i, int count) {
    while (i < 0 || i >= count) i = count == 1 ? 0 : i < 0 ? -i : 2 * count - 2 - i;
    return i;
}

// A pixel of an image's plane; of a mosaic the 3x3 binomial mean around it, mirrored at the border, which mixes all
// colours in the same proportion (`luminance` in spiked/recon/frontend/windowing.py).
struct Plane {
    int width, height, colours, colour;
    bool mosaic;

    SPIKED_DEVICE int64_t place(int x, int y) const { return (static_cast<int64_t>(y) * width + x) * colours + colour; }
    SPIKED_DEVICE bool has(int x, int y) const { return x >= 0 && x < width && y >= 0 && y < height; }
    SPIKED_DEVICE float at(const float* image, int x, int y) const {
        if (!mosaic) return image[place(x, y)];
        float sum = 0;
        for (int j = -1; j <= 1; ++j) {
            const float* row = image + static_cast<int64_t>(mirrored(y + j, height)) * width;
            const float mixed = 0.25f * (row[mirrored(x - 1, width)] + row[mirrored(x + 1, width)]) + 0.5f * row[x];
            sum += (j == 0 ? 0.5f : 0.25f) * mixed;
        }
        return sum;
    }
};

constexpr int kHalo = kTile + 2 * kReach;  // pixels that the windows of a tile's reach, on a side

// A tile of a colour, which a block of threads has, and what the windows of its pixels reach.
struct WindowTile {
    Plane plane;
    int left, top;

    SPIKED_DEVICE WindowTile(const Compared& image, uint32_t index) {
        const int across = (image.width + kTile - 1) / kTile, down = (image.height + kTile - 1) / kTile;
        const int tile = static_cast<int>(index) % (across * down);
        plane = {image.width, image.height, image.colours, static_cast<int>(index) / (across * down), image.mosaic};
        left = tile % across * kTile, top = tile / across * kTile;
    }
    SPIKED_DEVICE int x(int thread) const { return left + thread % kTile; }
    SPIKED_DEVICE int y(int thread) const { return top + thread / kTile; }
    // f(row, column, x, y, inside) for the pixels that a thread loads.
    template <class F>
    SPIKED_DEVICE void each_loaded(int thread, F f) const {
        for (int i = thread; i < kHalo * kHalo; i += kTilePixels) {
            const int x = left - kReach + i % kHalo, y = top - kReach + i / kHalo;
            f(i / kHalo, i % kHalo, x, y, plane.has(x, y));
        }
    }
};

// Structural similarity: its derivatives by the windowed moments of a pixel, and a block's sum.
struct CompareStructure {
    static constexpr int kThreads = kTilePixels;
    Compared image;
    SsimImage constants;
    const float* expected;
    float* derivatives;  // [3][height][width][colours]
    double* partial;     // [blocks]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        constexpr int kMoments = 5;
        SPIKED_SHARED float pixels[kMoments][kHalo][kHalo];
        SPIKED_SHARED float rows[kMoments][kHalo][kTile];
        SPIKED_SHARED double totals[Block<kThreads>::kWarps];
        PerThread<Sums<double, 1>, kThreads> sums;
        PerThread<bool, kThreads> some;
        const WindowTile tile(image, block.index);
        block.each([&](int thread) {
            tile.each_loaded(thread, [&](int row, int column, int x, int y, bool inside) {
                const float a = inside ? tile.plane.at(expected, x, y) : 0.0f;
                const float b = inside ? tile.plane.at(image.rates, x, y) : 0.0f;
                const float moments[kMoments] = {a, b, a * a, b * b, a * b};
                for (int m = 0; m < kMoments; ++m) pixels[m][row][column] = moments[m];
            });
        });
        block.sync();
        block.each([&](int thread) {
            for (int i = thread; i < kHalo * kTile; i += kThreads)
                for (int m = 0; m < kMoments; ++m)
                    rows[m][i / kTile][i % kTile] = windowed(&pixels[m][i / kTile][i % kTile + kReach], 1);
        });
        block.sync();
        block.each([&](int thread) {
            const int x = tile.x(thread), y = tile.y(thread);
            sums[thread] = {};
            some[thread] = tile.plane.has(x, y);
            if (!some[thread]) return;
            float moments[kMoments];
            for (int m = 0; m < kMoments; ++m)
                moments[m] = windowed(&rows[m][thread / kTile + kReach][thread % kTile], kTile);
            const Similar found = similar(constants, moments[0], moments[1], moments[2], moments[3], moments[4]);
            const int64_t at = tile.plane.place(x, y), count = image.values;
            derivatives[at] = found.by_mean;
            derivatives[count + at] = found.by_xx;
            derivatives[2 * count + at] = found.by_xy;
            sums[thread].of[0] = found.value;
        });
        block.sums(sums, some, totals, partial + block.index);
    }
};

// The gradient of the mean similarity by what it compares, [height][width][colours].
struct DifferentiateStructure {
    static constexpr int kThreads = kTilePixels;
    Compared image;
    const float *expected, *derivatives;
    float* gradient;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        SPIKED_SHARED float pixels[kHalo][kHalo];
        SPIKED_SHARED float rows[kHalo][kTile];
        struct Windowed {
            float of[3];
        };
        PerThread<Windowed, kThreads> by;
        const WindowTile tile(image, block.index);
        const int64_t count = image.values;
        for (int k = 0; k < 3; ++k) {
            block.each([&](int thread) {
                tile.each_loaded(thread, [&](int row, int column, int x, int y, bool inside) {
                    pixels[row][column] = inside ? derivatives[k * count + tile.plane.place(x, y)] : 0.0f;
                });
            });
            block.sync();
            block.each([&](int thread) {
                for (int i = thread; i < kHalo * kTile; i += kThreads)
                    rows[i / kTile][i % kTile] = windowed(&pixels[i / kTile][i % kTile + kReach], 1);
            });
            block.sync();
            block.each([&](int thread) {
                by[thread].of[k] = windowed(&rows[thread / kTile + kReach][thread % kTile], kTile);
            });
        }
        block.each([&](int thread) {
            const int x = tile.x(thread), y = tile.y(thread);
            if (!tile.plane.has(x, y)) return;
            const float a = tile.plane.at(expected, x, y), b = tile.plane.at(image.rates, x, y);
            const float (&d)[3] = by[thread].of;
            gradient[tile.plane.place(x, y)] = by_rendered(a, b, d[0], d[1], d[2]) / static_cast<float>(count);
        });
    }
};

// From the slopes by what is expected of the rates to those by the image.
struct MixSlopes {
    static constexpr int kThreads = kValueThreads;
    Compared image;
    RateLoss loss;
    const float* similarity;  // its gradient, or null where its share is 0
    float* slope;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= image.values) return;
            float sum = slope[at];
            if (similarity) {
                const int64_t pixel = at / image.colours;
                const Plane plane{image.width, image.height, image.colours, static_cast<int>(at % image.colours),
                                  image.mosaic};
                // The filter of a mosaic is symmetric, so it is its own transpose but for the border.
                const float by =
                    plane.at(similarity, static_cast<int>(pixel % image.width), static_cast<int>(pixel / image.width));
                sum = (1 - loss.share) * sum - loss.share * loss.scale * by;
            }
            slope[at] = sum * image.factor(at, loss.level);
        });
    }
};

// Adds a view to the normal equations of the pixels' gains.
struct AddEvidence {
    static constexpr int kThreads = kValueThreads;
    Compared image;
    float level, model_error;
    float *xx, *xy;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= image.values) return;
            const GainTerms terms = gain_terms(image.gain[at], image.rendered[at], image.rates[at], image.deviation[at],
                                               level, model_error);
            xx[at] += terms.xx;
            xy[at] += terms.xy;
        });
    }
};

}  // namespace
}  // namespace spiked
