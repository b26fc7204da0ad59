// The kernels of the charge loss, see spiked/render/charge.py and native/charge: warps by the depth of a render, and an
// image compared with the spikes of many frames. A pixel of the sensor has a thread.

namespace spiked {
namespace {

enum ChargeSum { kLoss, kCompared, kChi2, kIntervals, kExpected, kCounted, kChargeSums = 8 };  // a power of two

// Slopes are added up as whole multiples of 2^-24 floor^2: the order in which threads do it changes nothing.
constexpr float kSlopeSteps = 1 << 24;

// Of a render, as `_smooth_inverse` in spiked/recon/mapping/frame_warp.py.
struct DepthImage {
    const float* depth;  // [height][width], 0 where nothing is
    int width, height;
    float nearest;

    SPIKED_DEVICE float inverse(int64_t at) const { return 1.0f / fmaxf(depth[at], nearest); }
};

// Keys that sort the inverse depths, unknown ones last.
struct KeyDepths {
    static constexpr int kThreads = kValueThreads;
    DepthImage image;
    uint32_t *keys, *order;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= static_cast<int64_t>(image.width) * image.height) return;
            const float inverse = image.inverse(at);
            memcpy(&keys[at], &inverse, sizeof inverse);
            if (!(image.depth[at] > 0)) keys[at] = ~0u;
            order[at] = static_cast<uint32_t>(at);
        });
    }
};

// Their median; 1 if none is known.
struct MedianDepth {
    static constexpr int kThreads = kWarp;
    const uint32_t* keys;  // sorted
    int64_t count;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            if (thread > 0) return;
            int64_t known = 0, end = count;
            while (known < end) {
                const int64_t middle = (known + end) / 2;
                if (keys[middle] != ~0u) {
                    known = middle + 1;
                } else {
                    end = middle;
                }
            }
            const auto value = [&](int64_t at) {
                float found;
                memcpy(&found, &keys[at], sizeof found);
                return found;
            };
            *out = known == 0 ? 1.0f : 0.5f * (value((known - 1) / 2) + value(known / 2));
        });
    }
};

// Mean inverse depths over a square of `side` pixels; the border's are repeated.
struct SmoothDepths {
    static constexpr int kThreads = kValueThreads;
    DepthImage image;
    const float* unknown;
    int side;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= static_cast<int64_t>(image.width) * image.height) return;
            const int left = static_cast<int>(at % image.width) - side / 2;
            const int top = static_cast<int>(at / image.width) - side / 2;
            float sum = 0;
            for (int j = top; j < top + side; ++j)
                for (int i = left; i < left + side; ++i) {
                    const int x = i < 0 ? 0 : i < image.width ? i : image.width - 1;
                    const int y = j < 0 ? 0 : j < image.height ? j : image.height - 1;
                    const int64_t pixel = static_cast<int64_t>(y) * image.width + x;
                    sum += image.depth[pixel] > 0 ? image.inverse(pixel) : *unknown;
                }
            out[at] = sum / static_cast<float>(side * side);
        });
    }
};

// Displacements of nodes, a node of a frame a thread.
struct WarpNodes {
    static constexpr int kThreads = kValueThreads;
    InverseDepths depths;
    const float *turn, *shift;  // [frames][9], [frames][3]
    int frames, rows, columns;
    float cell;
    float* out;  // [frames][rows][columns][2]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= static_cast<int64_t>(frames) * rows * columns) return;
            const int node = static_cast<int>(at % (rows * columns)), frame = static_cast<int>(at / (rows * columns));
            const float x = cell * static_cast<float>(node % columns), y = cell * static_cast<float>(node / columns);
            warp_node(depths, turn + 9 * frame, shift + 3 * frame, x, y, x, y, [](float&, float&) {}, out + 2 * at);
        });
    }
};

// Frames of spikes, and the image that they are compared with.
struct ChargeScene {
    SpikeLayout spikes;
    const uint8_t* bytes;
    int frames;
    const float* nodes;  // [frames][rows][columns][2]
    int rows, columns, cell;
    const float* image;  // [height][width][colours]
    int width, height, colours;
    float pixel;               // side of an image pixel in sensor pixels
    const float *gain, *dark;  // of the sensor; dark may be null
    float level;               // times the gain
    float floor, jitter;
    int every, phase;  // of `every` pairs of rows, the one of number `phase` is used

    // Rows that are used, the last of which may be beyond the sensor.
    SPIKED_DEVICE int row(int number) const { return 2 * (phase + number / 2 * every) + number % 2; }

    // Where a pixel of a frame is in the image.
    SPIKED_DEVICE Spot spot(int frame, int x, int y) const {
        const float place = (static_cast<float>(y) + 0.5f) / static_cast<float>(cell);
        const int upper = static_cast<int>(place) < rows - 2 ? static_cast<int>(place) : rows - 2;
        const int left = x / cell < columns - 2 ? x / cell : columns - 2;
        const float down = place - static_cast<float>(upper);
        const float right = (static_cast<float>(x % cell) + 0.5f) / static_cast<float>(cell);
        const float* a = nodes + 2 * ((static_cast<int64_t>(frame) * rows + upper) * columns + left);
        const float* b = a + 2 * columns;
        float moved[2];
        for (int k = 0; k < 2; ++k) {
            const float begin = a[k] + down * (b[k] - a[k]), end = a[k + 2] + down * (b[k + 2] - a[k + 2]);
            moved[k] = begin + right * (end - begin);
        }
        const float shrink = 1.0f / pixel;
        return spot_of((static_cast<float>(x) + 0.5f + moved[0]) * shrink - 0.5f,
                       (static_cast<float>(y) + 0.5f + moved[1]) * shrink - 0.5f, static_cast<float>(width) - 1.001f,
                       static_cast<float>(height) - 1.001f);
    }

    SPIKED_DEVICE int64_t place(const Spot& spot, int colour) const {
        return (static_cast<int64_t>(spot.line) * width + spot.column) * colours + colour;
    }

    SPIKED_DEVICE bool fires(int frame, int x, int y) const {
        const int stored = spikes.flipped ? spikes.height - 1 - y : y;
        const uint8_t byte = bytes[(static_cast<int64_t>(frame) * spikes.height + stored) * spikes.row_stride + x / 8];
        return byte >> (spikes.msb ? 7 - x % 8 : x % 8) & 1;
    }
};

// The loss of a pixel, and what its frames add to the slope; `residual` and `scatter` of the CPU.
struct CompareCharge {
    static constexpr int kThreads = kValueThreads;
    ChargeScene scene;
    int64_t pixels;    // of the rows that are used
    float* residuals;  // [frames][pixels], where a pixel fires
    int64_t* slope;    // [height][width][colours], in steps
    double* partial;   // [blocks][kChargeSums]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        SPIKED_SHARED double totals[Block<kThreads>::kWarps][kChargeSums];
        PerThread<Sums<double, kChargeSums>, kThreads> sums;
        PerThread<bool, kThreads> some;
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            sums[thread] = {};
            some[thread] = false;
            if (at >= pixels) return;
            const int x = static_cast<int>(at % scene.spikes.width);
            const int y = scene.row(static_cast<int>(at / scene.spikes.width));
            if (y >= scene.spikes.height) return;
            const int64_t site = static_cast<int64_t>(y) * scene.spikes.width + x;
            const float gain = scene.gain[site] * scene.level;
            if (!(gain > 0)) return;
            some[thread] = true;
            compare(at, x, y, gain, scene.dark ? scene.dark[site] : 0, sums[thread].of);
        });
        block.sums(sums, some, &totals[0][0], partial + static_cast<int64_t>(block.index) * kChargeSums);
    }

  private:
    SPIKED_DEVICE void compare(int64_t at, int x, int y, float gain, float dark, double* sums) const {
        const int colour = scene.colours > 1 ? scene.spikes.tile[y % 2 * 2 + x % 2] : 0;
        const int64_t right = scene.colours, below = static_cast<int64_t>(scene.width) * scene.colours;
        uint64_t inside = 0, fired = 0;  // by frame
        Gathered seen{};
        float residual = 0;
        for (int f = 0; f < scene.frames; ++f) {
            const Spot spot = scene.spot(f, x, y);
            if (!spot.inside) continue;
            inside |= uint64_t{1} << f;
            const float* p = scene.image + scene.place(spot, colour);
            const float upper = p[0] + spot.right * (p[right] - p[0]);
            const float lower = p[below] + spot.right * (p[below + right] - p[below]);
            // It fires at an unknown time in the frame: on average at its middle.
            const float half = 0.5f * (gain * (upper + spot.down * (lower - upper)) + dark), full = seen.charge + half;
            seen.charge = full + half;
            seen.seen += 1;
            if (!scene.fires(f, x, y)) continue;
            fired |= uint64_t{1} << f;
            const float now = full - seen.spikes, t = static_cast<float>(f);
            float wrong = 0;
            if (seen.spikes == 0) {
                seen.first = t, seen.charge_first = full;
            } else {
                wrong = now - residual;
                seen.lengths += (t - seen.last) * (t - seen.last);
                seen.squares += wrong * wrong;
            }
            seen.last = t, seen.charge_last = full;
            residual = now;
            residuals[f * pixels + at] = wrong;
            seen.spikes += 1;
        }
        const Weighed found = weigh(seen, scene.floor * scene.floor, scene.jitter * scene.jitter);
        sums[kLoss] = found.loss, sums[kCompared] = found.enough, sums[kChi2] = found.chi2;
        sums[kIntervals] = found.intervals, sums[kExpected] = found.expected, sums[kCounted] = found.counted;
        if (found.enough) scatter(at, x, y, colour, gain, inside, fired, static_cast<int>(seen.first), found);
    }

    // Each frame's slope goes to the four image pixels that its light came from.
    SPIKED_DEVICE void scatter(int64_t at, int x, int y, int colour, float gain, uint64_t inside, uint64_t fired,
                               int first, const Weighed& found) const {
        const int64_t right = scene.colours, below = static_cast<int64_t>(scene.width) * scene.colours;
        const float steps = kSlopeSteps / (scene.floor * scene.floor);
        float after = found.outer;
        for (int f = scene.frames - 1; f >= 0; --f) {
            if (!(inside >> f & 1)) continue;
            float now = after;
            if (fired >> f & 1) now = f > first ? found.inner * residuals[f * pixels + at] : found.outer;
            const float by_light = 0.5f * (now + after) * gain * steps;
            after = now;
            const Spot spot = scene.spot(f, x, y);
            int64_t* p = slope + scene.place(spot, colour);
            const float lower = by_light * spot.down, upper = by_light - lower;
            add(p, upper - upper * spot.right);
            add(p + right, upper * spot.right);
            add(p + below, lower - lower * spot.right);
            add(p + below + right, lower * spot.right);
        }
    }

    SPIKED_DEVICE static void add(int64_t* sum, float value) { add_whole(sum, static_cast<int64_t>(rintf(value))); }
};

struct Clear {
    static constexpr int kThreads = kValueThreads;
    int64_t* values;
    int64_t count;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at < count) values[at] = 0;
        });
    }
};

// From steps to the gradient of the mean over the pixels that were compared.
struct MeanSlope {
    static constexpr int kThreads = kValueThreads;
    const int64_t* steps;
    const double* sums;  // [kChargeSums]
    float floor;
    int64_t count;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= count) return;
            const double compared = sums[kCompared] > 1 ? sums[kCompared] : 1;
            out[at] = static_cast<float>(static_cast<double>(steps[at]) / kSlopeSteps * floor * floor / compared);
        });
    }
};

// A blur of [height][width][colours] along one direction; see WarpedChargeLoss in spiked/recon/mapping/loss.py.
struct Blur {
    int width, height, colours;
    float window[kDetailReach + 1];  // weights of pixels 0 to kDetailReach from the middle

    SPIKED_DEVICE int64_t count() const { return static_cast<int64_t>(width) * height * colours; }
    // Of the element `at` of an image along its row, or across; what is beyond the border is mirrored.
    SPIKED_DEVICE float along(const float* image, int64_t at, bool across) const {
        const int64_t line = static_cast<int64_t>(width) * colours, apart = across ? line : colours;
        const int middle = static_cast<int>(across ? at / line : at % line / colours), end = across ? height : width;
        const float* first = image + (at - middle * apart);
        float sum = window[0] * image[at];
        for (int k = 1; k <= kDetailReach; ++k)
            sum += window[k] * (first[mirrored(middle - k, end) * apart] + first[mirrored(middle + k, end) * apart]);
        return sum;
    }
};

struct BlurRows {
    static constexpr int kThreads = kValueThreads;
    Blur blur;
    const float* in;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at < blur.count()) out[at] = blur.along(in, at, false);
        });
    }
};

// out = scale (in + detail (in - blurred)).
struct AddDetail {
    static constexpr int kThreads = kValueThreads;
    Blur blur;
    const float *in, *rows;  // rows: blurred along themselves
    float detail, scale;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at >= blur.count()) return;
            out[at] = scale * (in[at] + detail * (in[at] - blur.along(rows, at, true)));
        });
    }
};

// out = scale in.
struct Scale {
    static constexpr int kThreads = kValueThreads;
    const float* in;
    int64_t count;
    float scale;
    float* out;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            if (at < count) out[at] = scale * in[at];
        });
    }
};

}  // namespace
}  // namespace spiked
