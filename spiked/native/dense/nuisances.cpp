// Evidence of the brightness of a view and of the gains of pixels, see spiked/recon/mapping/photometric.py.
#include "nuisances.hpp"

#include "../common/arrays.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

using Image = Array<const float, 2>;

void expect_alike(size_t height, size_t width, std::initializer_list<const Image*> images) {
    for (const Image* one : images) expect(one->shape(0) == height && one->shape(1) == width, "images must be alike");
}

struct Light {
    float expected, observed;
};

// Of the pixels of a row that agree with the map within `sigmas` deviations.
SPIKED_CLONES Light agreeing_light(const float* gain, const float* rendered, const float* observed,
                                   const float* deviation, int64_t width, float model_error, float sigmas) {
    float expected_sum = 0, observed_sum = 0;
    for (int64_t x = 0; x < width; ++x) {
        const float expected = gain[x] * rendered[x];
        const bool counts = agrees(expected, observed[x], deviation[x], model_error, sigmas);
        expected_sum += counts ? expected : 0.0f;
        observed_sum += counts ? observed[x] : 0.0f;
    }
    return {expected_sum, observed_sum};
}

nb::tuple agreement(const Image& gain, const Image& rendered, const Image& observed, const Image& deviation,
                    float model_error, float sigmas) {
    const size_t height = gain.shape(0), width = gain.shape(1);
    expect_alike(height, width, {&rendered, &observed, &deviation});
    double expected_sum = 0, observed_sum = 0;
    for (size_t y = 0; y < height; ++y) {
        const size_t at = y * width;
        const Light row = agreeing_light(gain.data() + at, rendered.data() + at, observed.data() + at,
                                         deviation.data() + at, static_cast<int64_t>(width), model_error, sigmas);
        expected_sum += row.expected;
        observed_sum += row.observed;
    }
    return nb::make_tuple(expected_sum, observed_sum);
}

SPIKED_CLONES void add_evidence(const float* gain, const float* rendered, const float* observed, const float* deviation,
                                int64_t count, float level, float model_error, float* xx, float* xy) {
    for (int64_t i = 0; i < count; ++i) {
        const GainTerms terms = gain_terms(gain[i], rendered[i], observed[i], deviation[i], level, model_error);
        xx[i] += terms.xx;
        xy[i] += terms.xy;
    }
}

void gain_evidence(const Image& gain, const Image& rendered, const Image& observed, const Image& deviation, float level,
                   float model_error, const Array<float, 2>& xx, const Array<float, 2>& xy) {
    const size_t height = gain.shape(0), width = gain.shape(1);
    expect_alike(height, width, {&rendered, &observed, &deviation});
    expect(xx.size() == height * width && xy.size() == height * width, "images must be alike");
    add_evidence(gain.data(), rendered.data(), observed.data(), deviation.data(), static_cast<int64_t>(height * width),
                 level, model_error, xx.data(), xy.data());
}

}  // namespace

void bind_nuisances(nb::module_& m) {
    m.def("agreement", &agreement, nb::arg("gain"), nb::arg("rendered"), nb::arg("observed"), nb::arg("deviation"),
          nb::arg("model_error"), nb::arg("sigmas"),
          "Light expected and light observed, summed over the pixels where they agree within their noise.");
    m.def("gain_evidence", &gain_evidence, nb::arg("gain"), nb::arg("rendered"), nb::arg("observed"),
          nb::arg("deviation"), nb::arg("level"), nb::arg("model_error"), nb::arg("xx").noconvert(),
          nb::arg("xy").noconvert(), "Adds a view to the normal equations of the pixels' gains.");
}

}  // namespace spiked
