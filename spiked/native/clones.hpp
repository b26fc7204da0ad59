#pragma once

// A function compiled once for each instruction set and chosen when the module is loaded, where GCC can do that.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define SPIKED_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define SPIKED_CLONES
#endif

// A loop over lanes: one vector each, rather than unrolled before anybody sees that.
#define SPIKED_LANES _Pragma("GCC unroll 1") _Pragma("GCC ivdep")
