// Stands in for cuda.cu where there is no nvcc.
#include <stdexcept>

#include "renderer.hpp"

namespace spiked {

std::string why_no_cuda() {
    return "spiked was built without CUDA: build it where nvcc is in PATH, or after pip install nvidia-cuda-nvcc "
           "nvidia-cuda-crt nvidia-nvvm nvidia-cuda-runtime nvidia-cuda-cccl";
}

std::unique_ptr<GpuRenderer> cuda_renderer(const PinholeF&) { throw std::runtime_error(why_no_cuda()); }

std::string cuda_device() { throw std::runtime_error(why_no_cuda()); }

}  // namespace spiked
