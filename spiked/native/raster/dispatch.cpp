#include <cstdlib>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace raster {

// The widest kernels that this machine runs, or those that SPIKED_SIMD names (baseline, avx2, avx512; neon).
const Kernels& choose_kernels() {
    const char* variable = std::getenv("SPIKED_SIMD");
    const std::string wanted = variable ? variable : "";
#if defined(__x86_64__)
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
    if (avx512 && (wanted.empty() || wanted == kAvx512.name)) return kAvx512;
    if (avx2 && (wanted.empty() || wanted == kAvx2.name)) return kAvx2;
#elif defined(__aarch64__)
    if (wanted.empty() || wanted == kNeon.name) return kNeon;
#endif
    if (wanted.empty() || wanted == kBaseline.name) return kBaseline;
    throw std::invalid_argument(
        "SPIKED_SIMD=" + wanted +
        " is not an instruction set of this machine; use avx512, avx2, neon or baseline, or unset it");
}

}  // namespace raster
