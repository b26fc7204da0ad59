#include "../common/dispatch.hpp"

#include "kernels.hpp"

namespace spiked {

const RasterKernels& choose_kernels() { return SPIKED_WIDEST_FLOAT_KERNELS(RasterKernels, raster_kernels); }

}  // namespace spiked
