// Motion compensation: spikes warped along the image motion to one time and added up.
#include <algorithm>
#include <stdexcept>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

constexpr int kWeightCell = 4;  // the weight image has one pixel for 4x4 of the sensor's

// Adds `value` at (x, y) to the four pixels around it, bilinearly; pixel centres are at whole numbers.
SPIKED_INLINE void splat_bilinear(float* image, int64_t width, int64_t height, float x, float y, float value) {
    if (!(x >= 0 && y >= 0 && x < static_cast<float>(width - 1) && y < static_cast<float>(height - 1))) return;
    const auto column = static_cast<int32_t>(x), row = static_cast<int32_t>(y);
    const float u = x - static_cast<float>(column), v = y - static_cast<float>(row);
    float* at = image + row * width + column;
    at[0] += (1 - u) * (1 - v) * value;
    at[1] += u * (1 - v) * value;
    at[width] += (1 - u) * v * value;
    at[width + 1] += u * v * value;
}

// The displacement of every grid column on one sensor row: linear between the grid rows above and below.
SPIKED_INLINE void grid_row(const float* grid, int64_t rows, int64_t columns, float y, std::vector<float>& out) {
    const float at = std::min(std::max(y, 0.0f), static_cast<float>(rows - 1));
    const int64_t i = std::min(static_cast<int64_t>(at), rows - 2);
    const float v = at - static_cast<float>(i);
    const float* a = grid + i * columns * 2;
    const float* b = a + columns * 2;
    for (int64_t k = 0; k < columns * 2; ++k) out[k] = a[k] + v * (b[k] - a[k]);
}

struct Sensor {
    int64_t width, height, row_stride;
    bool flipped, msb;
};

// A grid of displacements for each frame.
struct Fields {
    const float* data;
    int64_t frames, rows, columns, cell;
    float scale;  // 1 / cell

    const float* of(int64_t n) const { return data + n * rows * columns * 2; }
};

SPIKED_CLONES void add_spikes(const Sensor& sensor, const Fields& fields, const uint8_t* frames, int64_t frame_stride,
                              float* out) {
    std::vector<float> line(fields.columns * 2);
    for (int64_t n = 0; n < fields.frames; ++n) {
        for (int64_t y = 0; y < sensor.height; ++y) {
            const uint8_t* row =
                frames + n * frame_stride + (sensor.flipped ? sensor.height - 1 - y : y) * sensor.row_stride;
            grid_row(fields.of(n), fields.rows, fields.columns, (static_cast<float>(y) + 0.5f) * fields.scale, line);
            for (int64_t byte = 0; byte < sensor.width / 8; ++byte) {
                uint8_t bits = row[byte];
                if (!bits) continue;
                const int64_t column = byte * 8 / fields.cell;
                const float* a = line.data() + column * 2;
                const float start = static_cast<float>(byte * 8 - column * fields.cell) + 0.5f;
                while (bits) {
                    const int bit = __builtin_ctz(bits);
                    bits = static_cast<uint8_t>(bits & (bits - 1));
                    const int k = sensor.msb ? 7 - bit : bit;
                    const float u = (start + static_cast<float>(k)) * fields.scale;
                    splat_bilinear(out, sensor.width, sensor.height,
                                   static_cast<float>(byte * 8 + k) + a[0] + u * (a[2] - a[0]),
                                   static_cast<float>(y) + a[1] + u * (a[3] - a[1]), 1.0f);
                }
            }
        }
    }
}

// Adds the number of sensor pixels that each pixel of the weight image gets.
SPIKED_CLONES void add_weight(const Sensor& sensor, const Fields& fields, float* out) {
    const int64_t width = (sensor.width + kWeightCell - 1) / kWeightCell,
                  height = (sensor.height + kWeightCell - 1) / kWeightCell;
    std::vector<float> line(fields.columns * 2);
    for (int64_t n = 0; n < fields.frames; ++n) {
        for (int64_t j = 0; j < height; ++j) {
            const float y = static_cast<float>(j * kWeightCell) + 0.5f * kWeightCell;
            grid_row(fields.of(n), fields.rows, fields.columns, y * fields.scale, line);
            for (int64_t i = 0; i < width; ++i) {
                const float x = static_cast<float>(i * kWeightCell) + 0.5f * kWeightCell;
                const int64_t column = std::min(static_cast<int64_t>(x * fields.scale), fields.columns - 2);
                const float u = x * fields.scale - static_cast<float>(column);
                const float* a = line.data() + column * 2;
                splat_bilinear(out, width, height, (x + a[0] + u * (a[2] - a[0])) / kWeightCell - 0.5f,
                               (y + a[1] + u * (a[3] - a[1])) / kWeightCell - 0.5f, 1.0f);
            }
        }
    }
}

void warp_spikes(const Frames& frames, size_t width, size_t height, size_t row_stride, bool flipped, bool msb,
                 const Array<const float, 4>& grids, size_t cell, const Array<float, 2>& spikes,
                 const Array<float, 2>& weight) {
    const Sensor sensor = {static_cast<int64_t>(width), static_cast<int64_t>(height), static_cast<int64_t>(row_stride),
                           flipped, msb};
    if (width == 0 || width % 8 || cell == 0 || cell % 8 || row_stride < width / 8) {
        throw std::invalid_argument("a row is whole bytes and fits its stride, and so are the cells of a grid");
    }
    if (frames.shape(1) != row_stride * height || frames.stride(1) != 1 || frames.shape(0) != grids.shape(0)) {
        throw std::invalid_argument("frames must be uint8 [n, row_stride * height], with a grid for each");
    }
    if (grids.shape(3) != 2 || grids.shape(1) < 2 || grids.shape(2) < 2 || (grids.shape(2) - 1) * cell < width ||
        (grids.shape(1) - 1) * cell < height) {
        throw std::invalid_argument("grids must be float32 [n, rows, columns, 2] and cover the sensor");
    }
    if (spikes.shape(0) != height || spikes.shape(1) != width ||
        weight.shape(0) != (height + kWeightCell - 1) / kWeightCell ||
        weight.shape(1) != (width + kWeightCell - 1) / kWeightCell) {
        throw std::invalid_argument("the images must be float32 [height, width] and a quarter of that, rounded up");
    }
    const Fields fields = {grids.data(),
                           static_cast<int64_t>(grids.shape(0)),
                           static_cast<int64_t>(grids.shape(1)),
                           static_cast<int64_t>(grids.shape(2)),
                           static_cast<int64_t>(cell),
                           1.0f / static_cast<float>(cell)};
    nb::gil_scoped_release release;
    add_spikes(sensor, fields, frames.data(), frames.stride(0), spikes.data());
    add_weight(sensor, fields, weight.data());
}

}  // namespace

void bind_warp(nb::module_& m) {
    m.def("warp_spikes", &warp_spikes, nb::arg("frames"), nb::arg("width"), nb::arg("height"), nb::arg("row_stride"),
          nb::arg("flipped"), nb::arg("msb"), nb::arg("grids"), nb::arg("cell"), nb::arg("spikes").noconvert(),
          nb::arg("weight").noconvert(),
          "Adds each frame's spikes, moved by its grid of displacements (px), to `spikes`, and the number of sensor\n"
          "pixels that arrive at each place to `weight`, which has a pixel for every 4x4 of the sensor's.");
}

}  // namespace spiked
