#pragma once

// A function that is compiled once for each instruction set; the loader selects one when the module is loaded.
// Clang knows these levels from version 18 on.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && (!defined(__clang__) || __clang_major__ >= 18)
#define SPIKED_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define SPIKED_CLONES
#endif

// A function that clones call: Clang compiles one that it does not inline for the baseline alone. GCC inlines them all.
#if defined(__clang__)
#define SPIKED_INLINE [[gnu::always_inline]] inline
#else
#define SPIKED_INLINE inline
#endif

// For a loop over lanes: vectorised as one vector instead of unrolled first.
#if defined(__clang__)
#define SPIKED_LANES _Pragma("clang loop vectorize(assume_safety)")
#else
#define SPIKED_LANES _Pragma("GCC unroll 1") _Pragma("GCC ivdep")
#endif

#if defined(__x86_64__) && defined(__linux__) && defined(__clang__) && __clang_major__ >= 18
#include "cpu_features.hpp"

// What Clang's resolvers of clones ask: a word for each 32 features from number 32 on. They have a function of the
// compiler's runtime fill it, which in that of ziglang does nothing, so that every clone would be the default; defined
// here, it is found first. Numbers of the features: compiler-rt, lib/builtins/cpu_model/x86.c, whose enumeration is
// that of libgcc.
extern "C" {
[[gnu::visibility("hidden")]] inline unsigned __cpu_features2[3] = {};

[[gnu::visibility("hidden"), gnu::used]] inline int __cpu_indicator_init() {
    constexpr int kLevel3 = 97, kLevel4 = 98, kFirst = 32;  // FEATURE_X86_64_V3 and _V4
    const spiked::CpuFeatures cpu = spiked::cpu_features();
    const auto tell = [](int number) { __cpu_features2[(number - kFirst) / 32] |= 1u << (number - kFirst) % 32; };
    if (cpu.level3()) tell(kLevel3);
    if (cpu.level4()) tell(kLevel4);
    return 0;
}
}
#endif
