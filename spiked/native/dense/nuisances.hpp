// What one pixel tells of the brightness of its view and of its gain, see spiked/recon/mapping/photometric.py; a GPU's
// threads run the same lines (native/gpu).
#pragma once
#include <cmath>

#include "../common/clones.hpp"
#include "../common/device.hpp"

namespace spiked {
namespace {

// Whether what was expected and what was observed agree within `sigmas` deviations.
SPIKED_INLINE SPIKED_DEVICE bool agrees(float expected, float observed, float deviation, float model_error,
                                        float sigmas) {
    const float error = model_error * (expected + observed);
    // An infinite deviation says that nothing was seen.
    return std::fabs(observed - expected) < sigmas * (deviation + error) && deviation < 1e30f;
}

// What is added to the normal equation of a pixel's gain.
struct GainTerms {
    float xx, xy;
};

SPIKED_INLINE SPIKED_DEVICE GainTerms gain_terms(float gain, float rendered, float observed, float deviation,
                                                 float level, float model_error) {
    const float error = model_error * (gain * rendered + observed), model = rendered * level;
    const float weighted = model / (deviation * deviation + error * error + 1e-12f);
    return {weighted * model, weighted * (observed - model)};
}

}  // namespace
}  // namespace spiked
