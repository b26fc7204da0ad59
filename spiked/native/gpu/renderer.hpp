// The renderer of ../raster on a GPU, and its emulation: the same kernels, looped over their grids on the CPU.
#pragma once
#include <memory>
#include <string>
#include <vector>

#include "../raster/renderer.hpp"

namespace spiked {

// Splats that stay on the device, with the moments of Adam.
class GpuScene {
  public:
    virtual ~GpuScene() = default;

    int count() const { return count_; }
    int colours() const { return colours_; }
    // Moments are [count][11 + colours], a splat's means, quaternion, log scales, opacity logit and colours in turn;
    // taken [count] are its steps.
    virtual void set(const SplatArrays&, const float* first, const float* second, const uint32_t* taken) = 0;
    virtual void get(float* means, float* quats, float* log_scales, float* opacity_logits, float* colours, float* first,
                     float* second, uint32_t* taken) = 0;
    // Keeps the splats `rows`, in that order, with their moments.
    virtual void select(const uint32_t* rows, size_t count) = 0;
    // Adds splats without moments, of as many colours.
    virtual void join(const SplatArrays&) = 0;
    virtual void opacity_logits(float*) = 0;

  protected:
    int count_ = 0, colours_ = 1;
};

// A step of Adam on all splats that the last image showed.
struct DescentRates {
    float rates[5];  // of the five arrays
    float blur;      // see SplatAxes
    bool own_axes;
    float beta1, beta2, epsilon;
    float most_log_scale;  // log scales stay below, and colours at or above 0
    float widest;          // and so do standard deviations over the distance from the camera at `centre`
    float centre[3];
};

// A view on the device, of the size of a renderer's images.
class GpuFrame {
  public:
    virtual ~GpuFrame() = default;

    int width = 0, height = 0;
    size_t values = 0;  // of its rates, [height][width] or [height][width][3]
    bool mosaic = false, moving = false;
};

// The same in main memory: start and stop, see Views, or null for a camera that stands still; channels or null.
struct FrameArrays {
    size_t values;
    const float *rates, *deviation;
    const float* windows;  // [2][height][width]
    const uint8_t* channels;
};

// How an image is compared with a view, see RateLoss in spiked/recon/mapping/loss.py.
struct RateLoss {
    float white, floor;         // floor: in units of white
    float share, scale;         // of structural similarity
    bool gains;                 // those of the renderer count, and
    float level;                // this brightness of the view
    float model_error, sigmas;  // of pixels that agree, see dense/nuisances.hpp
};

struct RateComparison {
    double error;                       // mean weighted squared error, in units of white
    double similarity;                  // mean; 1 where its share is 0
    double expected_light, seen_light;  // summed over the pixels that agree; 0 without gains
};

// How the bits of a stored frame lie; tile has the colours of a mosaic's 2x2 sites.
struct SpikeLayout {
    int width, height, row_stride;
    bool flipped, msb;
    uint8_t tile[4];
};

// Frames of spikes on the device.
class GpuSpikes {
  public:
    virtual ~GpuSpikes() = default;

    SpikeLayout layout{};
    int frames = 0;
};

// What multiplies the light of a sensor's pixels on the device, and what is added to it.
class GpuLight {
  public:
    virtual ~GpuLight() = default;

    int width = 0, height = 0;
    bool dark = false;
};

constexpr int kDetailReach = 6;  // pixels of the blur that separates detail

// How an image is compared with spikes, see ChargeLoss in spiked/render/charge.py and WarpedChargeLoss in
// spiked/recon/mapping/loss.py.
struct ChargeLoss {
    const float *turn, *shift;  // [frames][9], [frames][3], see native/charge/warp_node.hpp
    int cell;                   // px of the sensor between nodes
    float nearest;              // depth
    float pixel;                // side of an image pixel in sensor pixels
    int every, phase;           // of `every` pairs of rows, the one of number `phase` is used
    float level;                // times the gain
    float floor, jitter;
    float scale;   // of the slope
    float detail;  // gain of what the blur takes away; 0 for none
    float window[kDetailReach + 1];
};

struct ChargeComparison {
    double loss, pixels, chi2, intervals, expected, counted;  // sums, as ChargeSums
};

class GpuRenderer {
  public:
    virtual ~GpuRenderer() = default;

    // Copies what it is given: nothing has to stay as it is for backward().
    virtual void forward(const SplatArrays&, const Views&, const float background[3], float* values, float* alpha,
                         float* depth) = 0;
    virtual void backward(const float* d_values, const GradientArrays&) = 0;
    // The same for splats that are on this renderer's kind of device; the gradients go into a step, and stay there.
    virtual void forward(GpuScene&, const Views&, const float background[3], float* values, float* alpha,
                         float* depth) = 0;
    // d_values: null for those that the last comparison left on the device.
    virtual void descend(const float* d_values, GpuScene&, const DescentRates&) = 0;
    virtual std::unique_ptr<GpuScene> scene() const = 0;

    virtual std::unique_ptr<GpuFrame> frame(const FrameArrays&) = 0;
    // Of one colour, [height][width].
    virtual void set_gains(const float*) = 0;
    // Renders a frame's windows and compares the image, which stays on the device, as the slope by it does.
    virtual RateComparison compare(GpuScene&, GpuFrame&, const Views& poses, const float background[3],
                                   const RateLoss&) = 0;
    // [height][width] or [height][width][3], the slope by the image of the last comparison.
    virtual void slope(float* out) = 0;
    // The same of the last one with spikes, neither scaled nor with detail; it stays until the next one.
    virtual void charge_slope(float* out) = 0;
    virtual size_t charge_values() const = 0;  // of that slope; 0 before any
    virtual std::unique_ptr<GpuSpikes> spikes(const SpikeLayout&, const uint8_t* bytes, int frames) = 0;
    // [height][width]; dark: or null.
    virtual std::unique_ptr<GpuLight> light(int width, int height, const float* gain, const float* dark) = 0;
    // Renders from one pose and compares the image, warped by its depth, with spikes.
    virtual ChargeComparison compare_charge(GpuScene&, GpuSpikes&, GpuLight&, const Views& pose,
                                            const float background[3], const ChargeLoss&) = 0;
    // The evidence of pixel gains, [height][width]; the last comparison, which was with this frame, is added to it.
    virtual void set_evidence(const float* xx, const float* xy) = 0;
    virtual void add_evidence(GpuFrame&, float level, float model_error) = 0;
    virtual void evidence(float* xx, float* xy) = 0;

    virtual const char* instructions() const = 0;
    const PinholeF& camera() const { return camera_; }
    const SplatArrays& splats() const { return splats_; }  // of the device
    int poses() const { return poses_; }
    bool mosaic() const { return mosaic_; }
    bool compared() const { return compared_; }  // whether the last image was
    bool has_gains() const { return has_gains_; }
    bool has_evidence() const { return has_evidence_; }

  protected:
    explicit GpuRenderer(const PinholeF& camera) : camera_(camera) {}

    PinholeF camera_;
    SplatArrays splats_{};
    int poses_ = 0;
    bool mosaic_ = false, compared_ = false, has_gains_ = false, has_evidence_ = false;
};

std::unique_ptr<GpuRenderer> emulated_renderer(const PinholeF&);
// Throws std::runtime_error where `why_no_cuda` says something.
std::unique_ptr<GpuRenderer> cuda_renderer(const PinholeF&);
// Why there is no GPU to render with; empty if there is one.
std::string why_no_cuda();
// The name of the GPU.
std::string cuda_device();

}  // namespace spiked
