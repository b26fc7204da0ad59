// Kernels compiled once for each instruction set: CMake's spiked_kernels() compiles a source several times, with
// SPIKED_INSTRUCTION_SET defined as the name of the set. Each copy defines one constant table of function pointers.
// The functions of a table are listed in a file `kernel_list.inl`, an X-macro of SPIKED_KERNEL(result, name,
// arguments).
//
// Plain data and pointers only where kernels are included: a template or inline function that is shared with the rest
// of a module could be linked from the wrong instruction set's copy.
#pragma once

#define SPIKED_JOIN2(a, b) a##_##b
#define SPIKED_JOIN(a, b) SPIKED_JOIN2(a, b)
#define SPIKED_QUOTE2(a) #a
#define SPIKED_QUOTE(a) SPIKED_QUOTE2(a)

// The table that a copy defines, and the name of its instruction set.
#define SPIKED_KERNEL_TABLE(prefix) SPIKED_JOIN(prefix, SPIKED_INSTRUCTION_SET)
#define SPIKED_INSTRUCTION_SET_NAME SPIKED_QUOTE(SPIKED_INSTRUCTION_SET)

// Declares the tables that exist for this processor.
#if defined(__x86_64__)
#define SPIKED_DECLARE_KERNEL_TABLES(Kernels, prefix) \
    extern const Kernels prefix##_baseline, prefix##_avx2, prefix##_avx512;
#elif defined(__aarch64__)
#define SPIKED_DECLARE_KERNEL_TABLES(Kernels, prefix) extern const Kernels prefix##_baseline, prefix##_neon;
#else
#define SPIKED_DECLARE_KERNEL_TABLES(Kernels, prefix) extern const Kernels prefix##_baseline;
#endif
