// All kernels of the rasteriser, compiled once for each instruction set.
#include "kernels.hpp"

// Each part uses the ones before it.
// clang-format off
#include "../common/simd.hpp"
#include "project.inl"
#include "intersect_tiles.inl"
#include "moving_camera.inl"
#include "composite.inl"
#include "adam.inl"
#include "similarity.inl"
#include "ssim.inl"
// clang-format on

namespace spiked {

const RasterKernels SPIKED_KERNEL_TABLE(raster_kernels) = {
    SPIKED_INSTRUCTION_SET_NAME,
#define SPIKED_KERNEL(result, name, arguments) name,
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};

}  // namespace spiked
