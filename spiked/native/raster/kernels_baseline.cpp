#include "kernels.hpp"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace raster {
namespace {
// Each part uses the ones before it.
// clang-format off
#include "vector.inl"
#include "project.inl"
#include "emit.inl"
#include "moving.inl"
#include "raster.inl"
#include "losses.inl"
#include "charge.inl"
// clang-format on
}  // namespace

const Kernels kBaseline = {"baseline",     prepare,   project,          emit,         forward, store_tile, backward,
                           project_moving, unproject, unproject_moving, cover,        finish,  adam,       robust,
                           ssim,           charge,    charge_scratch,   multiply_add, kLanes};
}  // namespace raster
