// The charge loss on several threads. Each band of sensor rows adds to an image of its own, so that the result does not
// depend on the number of threads.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/dispatch.hpp"
#include "../common/pool.hpp"
#include "bindings.hpp"
#include "kernels.hpp"

namespace spiked {
namespace {

constexpr int kBands = 8;

struct Band {
    int64_t first = 0, last = 0;  // image rows that it adds to
    std::vector<float> slope;
    ChargeSums sums;
};

class ChargeLoss {
  public:
    explicit ChargeLoss(int threads) : pool_(threads) {}

    nb::tuple run(Array<const uint8_t, 2> frames, int64_t width, int64_t height, int64_t row_stride, bool flipped,
                  bool msb, Array<const uint8_t, 1> tile, Array<const float, 4> grids, int64_t cell,
                  Array<const float, 3> image, float pixel, int64_t every, int64_t phase, Array<const float, 2> gain,
                  std::optional<Array<const float, 2>> dark, float floor, float jitter, Array<float, 3> slope) {
        const int64_t count = static_cast<int64_t>(frames.shape(0));
        const int64_t image_height = static_cast<int64_t>(image.shape(0));
        const int64_t image_width = static_cast<int64_t>(image.shape(1)),
                      colours = static_cast<int64_t>(image.shape(2));
        expect(width > 0 && width % 8 == 0 && height > 0 && height <= kMaxSide && width <= kMaxSide &&
                   row_stride >= width / 8,
               "a row is whole bytes and fits its stride");
        expect(count > 0 && count <= kMaxChargeFrames && static_cast<int64_t>(frames.shape(1)) == row_stride * height,
               "frames are uint8 [n, row_stride * height], at most 64");
        expect(cell > 0 && cell % 8 == 0 && static_cast<int64_t>(grids.shape(0)) == count && grids.shape(3) == 2 &&
                   grids.shape(1) > 1 && grids.shape(2) > 1 &&
                   (static_cast<int64_t>(grids.shape(2)) - 1) * cell >= width &&
                   (static_cast<int64_t>(grids.shape(1)) - 1) * cell >= height,
               "grids are float32 [n, rows, columns, 2] and cover the sensor");
        expect((colours == 1 || colours == 3) && image_width > 1 && image_height > 1 && image_width <= kMaxSide &&
                   image_height <= kMaxSide && pixel >= 1,
               "the image is float32 [h, w, 1 or 3], at least 2x2");
        expect(slope.shape(0) == image.shape(0) && slope.shape(1) == image.shape(1) && slope.shape(2) == image.shape(2),
               "the slope has the shape of the image");
        expect(tile.shape(0) == 4 && *std::max_element(tile.data(), tile.data() + 4) < 3, "a tile is four of 0, 1, 2");
        auto fits = [&](const auto& map) {
            return static_cast<int64_t>(map.shape(0)) == height && static_cast<int64_t>(map.shape(1)) == width;
        };
        expect(fits(gain) && (!dark || fits(*dark)), "gain and dark have the sensor's size");
        expect(every > 0 && phase >= 0 && phase < every, "phase is one of every");
        expect(floor > 0 && jitter > 0, "floor and jitter are positive");
        ChargeJob job{};
        job.frames = count, job.width = width, job.height = height;
        job.row_stride = row_stride, job.frame_stride = row_stride * height;
        job.every = every, job.phase = phase, job.flipped = flipped, job.msb = msb;
        std::copy(tile.data(), tile.data() + 4, job.tile);
        job.bytes = frames.data(), job.grids = grids.data();
        job.rows = static_cast<int64_t>(grids.shape(1)), job.columns = static_cast<int64_t>(grids.shape(2));
        job.cell = cell, job.image = image.data(), job.image_width = image_width, job.image_height = image_height;
        job.colours = static_cast<int32_t>(colours), job.pixel = pixel;
        job.gain = gain.data(), job.dark = dark ? dark->data() : nullptr;
        job.floor = floor, job.jitter = jitter;
        nb::gil_scoped_release release;
        const ChargeSums sums = all(job, slope.data());
        nb::gil_scoped_acquire acquire;
        return nb::make_tuple(sums.loss, sums.pixels, sums.chi2, sums.intervals, sums.expected, sums.counted);
    }

  private:
    ChargeSums all(ChargeJob job, float* slope) {
        const ChargeKernels& kernels = SPIKED_WIDEST_FLOAT_KERNELS(ChargeKernels, charge_kernels);
        const int64_t plane = job.image_height * job.image_width, colours = job.colours;
        scratch_.resize(static_cast<size_t>(pool_.threads()));
        planes_.resize(static_cast<size_t>(plane * colours));
        pool_.run(kBands, [&](int number, int) {
            for (int64_t i = plane * number / kBands; i < plane * (number + 1) / kBands; ++i)
                for (int64_t c = 0; c < colours; ++c)
                    planes_[static_cast<size_t>(c * plane + i)] = job.image[i * colours + c];
        });
        job.image = planes_.data();
        pool_.run(kBands, [&](int number, int thread) {
            Band& band = bands_[number];
            const int64_t first = job.height * number / kBands, last = job.height * (number + 1) / kBands;
            band.sums = {};
            std::tie(band.first, band.last) = reach(job, first, last);
            ChargeJob mine = job;
            mine.slope_row = band.first, mine.slope_plane = (band.last - band.first) * job.image_width;
            band.slope.assign(static_cast<size_t>(mine.slope_plane * colours), 0.0f);
            mine.slope = band.slope.data();
            std::vector<char>& scratch = scratch_[static_cast<size_t>(thread)];
            scratch.resize(static_cast<size_t>(kernels.charge_scratch()) + 64);
            const size_t skip = 64 - reinterpret_cast<uintptr_t>(scratch.data()) % 64;
            std::vector<float> lines(static_cast<size_t>(job.frames * job.columns * 2));
            kernels.charge(mine, first, last, lines.data(), scratch.data() + skip, band.sums);
        });
        pool_.run(kBands, [&](int number, int) {
            std::vector<float> line(static_cast<size_t>(job.image_width));
            for (int64_t y = job.image_height * number / kBands; y < job.image_height * (number + 1) / kBands; ++y)
                for (int64_t c = 0; c < colours; ++c)
                    gather(y, c, colours, line, slope + y * job.image_width * colours);
        });
        ChargeSums sums{};
        for (const Band& band : bands_) {
            sums.loss += band.sums.loss, sums.pixels += band.sums.pixels;
            sums.chi2 += band.sums.chi2, sums.intervals += band.sums.intervals;
            sums.expected += band.sums.expected, sums.counted += band.sums.counted;
        }
        return sums;
    }

    // The sum over all bands of a line of one colour, to every colours-th element of `out`.
    void gather(int64_t y, int64_t colour, int64_t colours, std::vector<float>& line, float* out) const {
        std::fill(line.begin(), line.end(), 0.0f);
        for (const Band& band : bands_) {
            if (y < band.first || y >= band.last) continue;
            const int64_t rows = band.last - band.first;
            const float* from =
                band.slope.data() + (colour * rows + y - band.first) * static_cast<int64_t>(line.size());
            for (size_t x = 0; x < line.size(); ++x) line[x] += from[x];
        }
        for (size_t x = 0; x < line.size(); ++x)
            out[x * static_cast<size_t>(colours) + static_cast<size_t>(colour)] = line[x];
    }

    // The image rows to which sensor rows [first, last) can be warped.
    static std::pair<int64_t, int64_t> reach(const ChargeJob& job, int64_t first, int64_t last) {
        const int64_t upper = std::min(first / job.cell, job.rows - 2);
        const int64_t lower = std::min((last + job.cell - 1) / job.cell + 1, job.rows - 1);
        float least = 0, most = 0;
        bool finite = true;
        for (int64_t f = 0; f < job.frames; ++f)
            for (int64_t k = upper * job.columns; k < (lower + 1) * job.columns; ++k) {
                const float moved = job.grids[(f * job.rows * job.columns + k) * 2 + 1];
                least = std::min(least, moved), most = std::max(most, moved);
                finite = finite && std::isfinite(moved);
            }
        if (!finite) return {0, job.image_height};
        const float low = std::floor((static_cast<float>(first) + least) / job.pixel) - 2;
        const float high = std::ceil((static_cast<float>(last) + most) / job.pixel) + 3;
        const float height = static_cast<float>(job.image_height);
        return {static_cast<int64_t>(std::clamp(low, 0.0f, height - 2)),
                static_cast<int64_t>(std::clamp(high, 2.0f, height))};
    }

    Pool pool_;
    Band bands_[kBands];
    std::vector<std::vector<char>> scratch_;
    std::vector<float> planes_;
};

}  // namespace

void bind_charge(nb::module_& m) {
    nb::class_<ChargeLoss>(m, "ChargeLoss")
        .def(nb::init<int>(), nb::arg("threads"))
        .def("run", &ChargeLoss::run, nb::kw_only(), nb::arg("frames"), nb::arg("width"), nb::arg("height"),
             nb::arg("row_stride"), nb::arg("flipped"), nb::arg("msb"), nb::arg("tile"), nb::arg("grids"),
             nb::arg("cell"), nb::arg("image"), nb::arg("pixel"), nb::arg("every"), nb::arg("phase"), nb::arg("gain"),
             nb::arg("dark").none(), nb::arg("floor"), nb::arg("jitter"), nb::arg("slope").noconvert());
}

}  // namespace spiked
