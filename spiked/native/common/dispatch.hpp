// Which kernels this machine can run. Not for files that hold kernels, see instruction_sets.hpp.
#pragma once
#include <cstdlib>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <vector>

#include "cpu_features.hpp"

namespace spiked {

template <class Kernels>
struct KernelChoice {
    const Kernels& kernels;
    bool runs_here;
};

// The tables that run on this machine, in the order given, or only the one that SPIKED_SIMD names (for tests and
// comparisons). Throws std::invalid_argument if SPIKED_SIMD names none of them.
template <class Kernels>
std::vector<const Kernels*> runnable_kernels(std::initializer_list<KernelChoice<Kernels>> widest_first) {
    const char* variable = std::getenv("SPIKED_SIMD");
    const std::string wanted = variable ? variable : "";
    std::vector<const Kernels*> found;
    for (const KernelChoice<Kernels>& choice : widest_first)
        if (choice.runs_here && (wanted.empty() || wanted == choice.kernels.name)) found.push_back(&choice.kernels);
    if (found.empty())
        throw std::invalid_argument(
            "SPIKED_SIMD=" + wanted +
            " is not an instruction set of this machine; use avx512, avx2, neon or baseline, or unset it");
    return found;
}

#if defined(__x86_64__)
// Asked once: CPUID leaves a virtual machine, which takes some 60 us.
inline const CpuFeatures& features_here() {
    static const CpuFeatures cpu = cpu_features();
    return cpu;
}

// The instructions that the floating-point kernels are compiled for.
inline bool has_avx2_floats() {
    const CpuFeatures& cpu = features_here();
    return cpu.avx2 && cpu.fma;
}
inline bool has_avx512_floats() {
    const CpuFeatures& cpu = features_here();
    return has_avx2_floats() && cpu.avx512f && cpu.avx512dq && cpu.avx512bw && cpu.avx512vl;
}
#endif

// The widest of the floating-point kernels with this prefix.
#if defined(__x86_64__)
#define SPIKED_WIDEST_FLOAT_KERNELS(Kernels, prefix)                                                              \
    *runnable_kernels<Kernels>(                                                                                   \
         {{prefix##_avx512, has_avx512_floats()}, {prefix##_avx2, has_avx2_floats()}, {prefix##_baseline, true}}) \
         .front()
#elif defined(__aarch64__)
#define SPIKED_WIDEST_FLOAT_KERNELS(Kernels, prefix) \
    *runnable_kernels<Kernels>({{prefix##_neon, true}, {prefix##_baseline, true}}).front()
#else
#define SPIKED_WIDEST_FLOAT_KERNELS(Kernels, prefix) *runnable_kernels<Kernels>({{prefix##_baseline, true}}).front()
#endif

}  // namespace spiked
