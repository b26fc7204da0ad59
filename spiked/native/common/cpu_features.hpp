// What this processor and the kernel below it can run, asked of the processor itself: __builtin_cpu_supports() answers
// "no" to everything where the compiler's runtime has only a stub of it, as that of ziglang has, with which wheels are
// built. Bits of CPUID and XCR0: Intel 64 and IA-32 Architectures Software Developer's Manual, volumes 1 and 2.
#pragma once
#if defined(__x86_64__)
#include <cpuid.h>

namespace spiked {

struct CpuFeatures {
    bool avx2, fma, bmi1, bmi2, f16c, lzcnt, movbe, avx512f, avx512cd, avx512dq, avx512bw, avx512vl, avx512bitalg, gfni;

    // The levels of the x86-64 psABI.
    bool level3() const { return avx2 && fma && bmi1 && bmi2 && f16c && lzcnt && movbe; }
    bool level4() const { return level3() && avx512f && avx512cd && avx512dq && avx512bw && avx512vl; }
};

inline CpuFeatures cpu_features() {
    constexpr unsigned kAvxState = 0x6, kAvx512State = 0xe6;  // registers that the kernel saves
    const auto bit = [](unsigned word, int number) { return (word >> number & 1) != 0; };
    CpuFeatures found{};
    unsigned a, b, c, d;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !bit(c, 27)) return found;  // OSXSAVE
    const bool fma = bit(c, 12), movbe = bit(c, 22), f16c = bit(c, 29);
    const bool lzcnt = __get_cpuid(0x80000001, &a, &b, &c, &d) && bit(c, 5);
    unsigned low, high;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & kAvxState) != kAvxState || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return found;
    found.avx2 = bit(b, 5);
    found.fma = fma;
    found.f16c = f16c;
    found.movbe = movbe;
    found.lzcnt = lzcnt;
    found.bmi1 = bit(b, 3);
    found.bmi2 = bit(b, 8);
    found.gfni = bit(c, 8);
    if ((low & kAvx512State) != kAvx512State) return found;
    found.avx512f = bit(b, 16);
    found.avx512dq = bit(b, 17);
    found.avx512cd = bit(b, 28);
    found.avx512bw = bit(b, 30);
    found.avx512vl = bit(b, 31);
    found.avx512bitalg = bit(c, 12);
    return found;
}

}  // namespace spiked
#endif
