#pragma once

// A function that GCC compiles once for each instruction set; the loader selects one when the module is loaded.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define SPIKED_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define SPIKED_CLONES
#endif

// For a loop over lanes: vectorised as one vector instead of unrolled first.
#define SPIKED_LANES _Pragma("GCC unroll 1") _Pragma("GCC ivdep")
