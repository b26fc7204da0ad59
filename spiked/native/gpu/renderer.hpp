// The renderer of ../raster on a GPU, and its emulation: the same kernels, looped over their grids on the CPU.
#pragma once
#include <memory>
#include <string>
#include <vector>

#include "../raster/renderer.hpp"

namespace spiked {

class GpuRenderer {
  public:
    virtual ~GpuRenderer() = default;

    // Copies what it is given: nothing has to stay as it is for backward().
    virtual void forward(const SplatArrays&, const Views&, const float background[3], float* values, float* alpha,
                         float* depth) = 0;
    virtual void backward(const float* d_values, const GradientArrays&) = 0;

    virtual const char* instructions() const = 0;
    const PinholeF& camera() const { return camera_; }
    const SplatArrays& splats() const { return splats_; }  // of the device
    int poses() const { return poses_; }
    bool mosaic() const { return mosaic_; }

  protected:
    explicit GpuRenderer(const PinholeF& camera) : camera_(camera) {}

    PinholeF camera_;
    SplatArrays splats_{};
    int poses_ = 0;
    bool mosaic_ = false;
};

std::unique_ptr<GpuRenderer> emulated_renderer(const PinholeF&);
// Throws std::runtime_error where `why_no_cuda` says something.
std::unique_ptr<GpuRenderer> cuda_renderer(const PinholeF&);
// Why there is no GPU to render with; empty if there is one.
std::string why_no_cuda();
// The name of the GPU.
std::string cuda_device();

}  // namespace spiked
