// The vector operations of the kernels, for the instruction set that a file is compiled for: bytes, of one pixel each,
// and single-precision floats. Everything here has internal linkage: the linker must not take another instruction set's
// copy.
#pragma once
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define SPIKED_INLINED __attribute__((always_inline))
#define SPIKED_DEVICE  // before functions that a GPU runs as well, see native/gpu/lane.hpp

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(SPIKED_NEON)
#include <arm_neon.h>
#endif

#if defined(__AVX512BITALG__) && defined(__GFNI__)
#define SPIKED_AVX512_BYTES 1
#endif
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define SPIKED_AVX512_FLOATS 1
#endif

namespace spiked {
namespace {

// Bytes. Shifts and bit tricks use 64-bit lanes, because no instruction set shifts bytes.

#if defined(SPIKED_AVX512_BYTES)
constexpr int kBytes = 64;
#elif defined(__AVX2__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 16;
#endif

typedef uint8_t Bytes __attribute__((vector_size(kBytes)));
typedef uint64_t Quads __attribute__((vector_size(kBytes)));

inline Bytes broadcast_byte(uint8_t value) { return Bytes{} + value; }

inline Bytes load(const uint8_t* from) {
    Bytes v;
    memcpy(&v, from, sizeof v);
    return v;
}

// Stores the first `room` bytes if there is no room for all; rows are multiples of eight pixels.
inline void store(uint8_t* to, Bytes v, size_t room) {
    if (room >= sizeof v) {
        memcpy(to, &v, sizeof v);
        return;
    }
#if defined(SPIKED_AVX512_BYTES)
    _mm512_mask_storeu_epi8(to, (uint64_t{1} << room) - 1, (__m512i)v);
#else
    const uint8_t* from = reinterpret_cast<const uint8_t*>(&v);
    for (size_t i = 0; i < room; i += 8) memcpy(to + i, from + i, 8);
#endif
}

// Half as many pixels with two bytes each; comparisons give 0 or 0xFFFF.
typedef uint16_t Words __attribute__((vector_size(kBytes)));

inline Words load_words(const uint16_t* from) {
    Words v;
    memcpy(&v, from, sizeof v);
    return v;
}

inline void store_words(uint16_t* to, Words v, size_t room) { store(reinterpret_cast<uint8_t*>(to), (Bytes)v, room); }

// Half a vector of bytes to two bytes each.
inline Words load_widened(const uint8_t* from) {
    typedef uint8_t half __attribute__((vector_size(kBytes / 2)));
    half v;
    memcpy(&v, from, sizeof v);
    return __builtin_convertvector(v, Words);
}

inline Words select(Words mask, Words yes, Words no) { return (yes & mask) | (no & ~mask); }

inline Bytes is_zero(Bytes v) { return (Bytes)(v == 0); }
inline Bytes low_nibble(Bytes v) { return v & 0x0F; }
inline Bytes high_nibble(Bytes v) { return (Bytes)((Quads)v >> 4) & 0x0F; }

#if defined(SPIKED_AVX512_BYTES)

inline Bytes smaller(Bytes a, Bytes b) { return (Bytes)_mm512_min_epu8((__m512i)a, (__m512i)b); }
inline Bytes larger(Bytes a, Bytes b) { return (Bytes)_mm512_max_epu8((__m512i)a, (__m512i)b); }
inline Bytes popcount(Bytes h) { return (Bytes)_mm512_popcnt_epi8((__m512i)h); }
inline Bytes lookup(__m128i table, Bytes nibble) {
    return (Bytes)_mm512_shuffle_epi8(_mm512_broadcast_i32x4(table), (__m512i)nibble);
}

#elif defined(__AVX2__)

inline Bytes smaller(Bytes a, Bytes b) { return (Bytes)_mm256_min_epu8((__m256i)a, (__m256i)b); }
inline Bytes larger(Bytes a, Bytes b) { return (Bytes)_mm256_max_epu8((__m256i)a, (__m256i)b); }
inline Bytes lookup(__m128i table, Bytes nibble) {
    return (Bytes)_mm256_shuffle_epi8(_mm256_broadcastsi128_si256(table), (__m256i)nibble);
}
inline Bytes popcount(Bytes h) {
    const __m128i bits = _mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
    return lookup(bits, low_nibble(h)) + lookup(bits, high_nibble(h));
}

#else

inline Bytes smaller(Bytes a, Bytes b) { return a < b ? a : b; }
#if defined(SPIKED_NEON)
inline Bytes popcount(Bytes h) { return (Bytes)vcntq_u8((uint8x16_t)h); }
#else
inline Bytes popcount(Bytes h) {
    h -= (Bytes)((Quads)h >> 1) & 0x55;
    h = (h & 0x33) + ((Bytes)((Quads)h >> 2) & 0x33);
    return low_nibble(h + (Bytes)((Quads)h >> 4));
}
#endif

// Index of the only set bit of each byte.
inline Bytes bit_index(Bytes one) {
    return (~is_zero(one & 0xAA) & 1) | (~is_zero(one & 0xCC) & 2) | (~is_zero(one & 0xF0) & 4);
}

#endif

#if defined(SPIKED_AVX512_BYTES)

// Number of zero bits below the lowest set bit, 8 where there is none.
inline Bytes trailing_zeros(Bytes h) { return popcount(~h & (h - 1)); }

// Index of the lowest set bit of each byte, kNever8 where there is none.
inline Bytes lowest(Bytes h) { return trailing_zeros(h) | is_zero(h); }

// Index of the highest set bit of each byte, kNever8 where there is none.
inline Bytes highest(Bytes h) {
    const __m512i reverse = _mm512_set1_epi64(static_cast<int64_t>(0x8040201008040201));
    return 7 - trailing_zeros((Bytes)_mm512_gf2p8affine_epi64_epi8((__m512i)h, reverse, 0));
}

#elif defined(__AVX2__)

// Index of the lowest set bit of each byte, kNever8 where there is none.
inline Bytes lowest(Bytes h) {
    const __m128i low = _mm_setr_epi8(-1, 0, 1, 0, 2, 0, 1, 0, 3, 0, 1, 0, 2, 0, 1, 0);
    const __m128i high = _mm_setr_epi8(-1, 4, 5, 4, 6, 4, 5, 4, 7, 4, 5, 4, 6, 4, 5, 4);
    return smaller(lookup(low, low_nibble(h)), lookup(high, high_nibble(h)));
}

// Index of the highest set bit of each byte, kNever8 where there is none.
inline Bytes highest(Bytes h) {
    const __m128i low = _mm_setr_epi8(0, 1, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4, 4, 4, 4);
    const __m128i high = _mm_setr_epi8(0, 5, 6, 6, 7, 7, 7, 7, 8, 8, 8, 8, 8, 8, 8, 8);
    return larger(lookup(low, low_nibble(h)), lookup(high, high_nibble(h))) - 1;
}

#else

#if defined(SPIKED_NEON)
// Leading zeros are 8 for none; turned around, those of the reversed byte are the trailing ones.
inline Bytes lowest(Bytes h) { return (Bytes)vclzq_u8(vrbitq_u8((uint8x16_t)h)) | is_zero(h); }
inline Bytes highest(Bytes h) { return 7 - (Bytes)vclzq_u8((uint8x16_t)h); }
#else
inline Bytes lowest(Bytes h) { return bit_index(h & -h) | is_zero(h); }

inline Bytes highest(Bytes h) {
    Bytes smeared = h | ((Bytes)((Quads)h >> 1) & 0x7F);
    smeared |= (Bytes)((Quads)smeared >> 2) & 0x3F;
    smeared |= high_nibble(smeared);
    return popcount(smeared) - 1;
}
#endif

#endif

#if defined(SPIKED_AVX512_BYTES)

inline __m512i low8(__m512i a, __m512i b) { return _mm512_unpacklo_epi8(a, b); }
inline __m512i high8(__m512i a, __m512i b) { return _mm512_unpackhi_epi8(a, b); }
inline __m512i low16(__m512i a, __m512i b) { return _mm512_unpacklo_epi16(a, b); }
inline __m512i high16(__m512i a, __m512i b) { return _mm512_unpackhi_epi16(a, b); }
inline __m512i low32(__m512i a, __m512i b) { return _mm512_unpacklo_epi32(a, b); }
inline __m512i high32(__m512i a, __m512i b) { return _mm512_unpackhi_epi32(a, b); }
typedef __m512i Register;

#elif defined(__AVX2__)

inline __m256i low8(__m256i a, __m256i b) { return _mm256_unpacklo_epi8(a, b); }
inline __m256i high8(__m256i a, __m256i b) { return _mm256_unpackhi_epi8(a, b); }
inline __m256i low16(__m256i a, __m256i b) { return _mm256_unpacklo_epi16(a, b); }
inline __m256i high16(__m256i a, __m256i b) { return _mm256_unpackhi_epi16(a, b); }
inline __m256i low32(__m256i a, __m256i b) { return _mm256_unpacklo_epi32(a, b); }
inline __m256i high32(__m256i a, __m256i b) { return _mm256_unpackhi_epi32(a, b); }
typedef __m256i Register;

#else

typedef uint32_t Dwords __attribute__((vector_size(kBytes)));
typedef Bytes Register;
inline Bytes low8(Bytes a, Bytes b) {
    return __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
}
inline Bytes high8(Bytes a, Bytes b) {
    return __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
}
inline Bytes low16(Bytes a, Bytes b) {
    return (Bytes)__builtin_shufflevector((Words)a, (Words)b, 0, 8, 1, 9, 2, 10, 3, 11);
}
inline Bytes high16(Bytes a, Bytes b) {
    return (Bytes)__builtin_shufflevector((Words)a, (Words)b, 4, 12, 5, 13, 6, 14, 7, 15);
}
inline Bytes low32(Bytes a, Bytes b) { return (Bytes)__builtin_shufflevector((Dwords)a, (Dwords)b, 0, 4, 1, 5); }
inline Bytes high32(Bytes a, Bytes b) { return (Bytes)__builtin_shufflevector((Dwords)a, (Dwords)b, 2, 6, 3, 7); }

#endif

// Eight vectors a_0..a_7 to their bytes in the order a_0[0] a_1[0] .. a_7[0] a_0[1] .., within each 128-bit lane.
inline void interleave(const Register in[8], Register out[8]) {
    const Register a0 = low8(in[0], in[1]), a1 = high8(in[0], in[1]);
    const Register b0 = low8(in[2], in[3]), b1 = high8(in[2], in[3]);
    const Register c0 = low8(in[4], in[5]), c1 = high8(in[4], in[5]);
    const Register d0 = low8(in[6], in[7]), d1 = high8(in[6], in[7]);
    const Register ab[4] = {low16(a0, b0), high16(a0, b0), low16(a1, b1), high16(a1, b1)};
    const Register cd[4] = {low16(c0, d0), high16(c0, d0), low16(c1, d1), high16(c1, d1)};
    for (int i = 0; i < 4; ++i) {
        out[2 * i] = low32(ab[i], cd[i]);
        out[2 * i + 1] = high32(ab[i], cd[i]);
    }
}

#if defined(SPIKED_AVX512_BYTES)

// kBytes bytes of each of eight frames to 8 * kBytes history bytes, one a pixel in image order: bit f is frame f.
inline void histories(const uint8_t* const* frames, size_t at, bool msb, Bytes out[8]) {
    // Lane l of the interleaved vector k holds byte columns 8 k + 2 l and 8 k + 2 l + 1.
    const __m512i spread = _mm512_set_epi16(31, 27, 23, 19, 15, 11, 7, 3, 30, 26, 22, 18, 14, 10, 6, 2,  //
                                            29, 25, 21, 17, 13, 9, 5, 1, 28, 24, 20, 16, 12, 8, 4, 0);
    // A 64-bit lane times the unit vectors is its transpose; the order of the unit vectors is the bit order.
    const __m512i units = _mm512_set1_epi64(msb ? 0x0102040810204080 : static_cast<int64_t>(0x8040201008040201));
    Register rows[8], columns[8];
    // The affine instruction counts matrix rows from the last byte of the lane, so frame 7 goes first.
    for (int f = 0; f < 8; ++f) rows[7 - f] = _mm512_permutexvar_epi16(spread, _mm512_loadu_si512(frames[f] + at));
    interleave(rows, columns);
    for (int i = 0; i < 8; ++i) out[i] = (Bytes)_mm512_gf2p8affine_epi64_epi8(units, columns[i], 0);
}

#else

// One stage of the transpose of eight 8x8 bit matrices whose rows lie in eight vectors.
template <int kShift>
inline void swap_bits(Bytes& a, Bytes& b, uint8_t mask) {
    const Bytes t = ((Bytes)((Quads)a >> kShift) ^ b) & mask;
    b ^= t;
    a ^= (Bytes)((Quads)t << kShift);
}

// kBytes bytes of each of eight frames to 8 * kBytes history bytes, one a pixel in image order: bit f is frame f.
inline void histories(const uint8_t* const* frames, size_t at, bool msb, Bytes out[8]) {
    Bytes m[8];
    for (int f = 0; f < 8; ++f) m[f] = load(frames[f] + at);
    for (int i = 0; i < 4; ++i) swap_bits<4>(m[i], m[i + 4], 0x0F);
    for (int i = 0; i < 4; ++i) swap_bits<2>(m[i + (i & 2)], m[i + (i & 2) + 2], 0x33);
    for (int i = 0; i < 8; i += 2) swap_bits<1>(m[i], m[i + 1], 0x55);
    Register columns[8], ordered[8];
    for (int i = 0; i < 8; ++i) columns[i] = (Register)m[msb ? 7 - i : i];
    interleave(columns, ordered);
#if defined(__AVX2__)
    for (int i = 0; i < 4; ++i) {
        out[i] = (Bytes)_mm256_permute2x128_si256(ordered[2 * i], ordered[2 * i + 1], 0x20);
        out[i + 4] = (Bytes)_mm256_permute2x128_si256(ordered[2 * i], ordered[2 * i + 1], 0x31);
    }
#else
    for (int i = 0; i < 8; ++i) out[i] = ordered[i];
#endif
}

#endif

// Floats. GCC splits vector types that are wider than the machine's into scalars, so a block of 16 pixels is
// 16 / kLanes native vectors, never one wide type.

#if defined(SPIKED_AVX512_FLOATS)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Vec __attribute__((vector_size(kLanes * 4)));
typedef int32_t Int __attribute__((vector_size(kLanes * 4)));

inline Vec broadcast(float x) { return x - Vec{}; }
inline Vec load(const float* p) {
    Vec v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
inline void store(float* p, Vec v) { __builtin_memcpy(p, &v, sizeof v); }
inline Int bits(Vec v) { return (Int)v; }

#if defined(SPIKED_AVX512_FLOATS)
inline Vec min(Vec a, Vec b) { return (Vec)_mm512_min_ps((__m512)a, (__m512)b); }
inline Vec max(Vec a, Vec b) { return (Vec)_mm512_max_ps((__m512)a, (__m512)b); }
inline Vec sqrt(Vec a) { return (Vec)_mm512_sqrt_ps((__m512)a); }
inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm512_unpacklo_ps((__m512)a, (__m512)b); }
inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm512_unpackhi_ps((__m512)a, (__m512)b); }
inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm512_shuffle_ps((__m512)a, (__m512)b, 0x44); }
inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm512_shuffle_ps((__m512)a, (__m512)b, 0xee); }
// value where x >= limit, else 0; for NaN 0.
inline Vec select_ge(Vec x, Vec limit, Vec value) {
    return (Vec)_mm512_maskz_mov_ps(_mm512_cmp_ps_mask((__m512)x, (__m512)limit, _CMP_GE_OQ), (__m512)value);
}
inline bool any_ge(Vec x, Vec limit) { return _mm512_cmp_ps_mask((__m512)x, (__m512)limit, _CMP_GE_OQ) != 0; }
// 1 / x, roughly.
inline Vec reciprocal(Vec x) { return (Vec)_mm512_rcp14_ps((__m512)x); }
#elif defined(__AVX2__)
inline Vec min(Vec a, Vec b) { return (Vec)_mm256_min_ps((__m256)a, (__m256)b); }
inline Vec max(Vec a, Vec b) { return (Vec)_mm256_max_ps((__m256)a, (__m256)b); }
inline Vec sqrt(Vec a) { return (Vec)_mm256_sqrt_ps((__m256)a); }
inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm256_unpacklo_ps((__m256)a, (__m256)b); }
inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm256_unpackhi_ps((__m256)a, (__m256)b); }
inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm256_shuffle_ps((__m256)a, (__m256)b, 0x44); }
inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm256_shuffle_ps((__m256)a, (__m256)b, 0xee); }
inline Vec select_ge(Vec x, Vec limit, Vec value) {
    return (Vec)_mm256_and_ps(_mm256_cmp_ps((__m256)x, (__m256)limit, _CMP_GE_OQ), (__m256)value);
}
inline bool any_ge(Vec x, Vec limit) {
    return _mm256_movemask_ps(_mm256_cmp_ps((__m256)x, (__m256)limit, _CMP_GE_OQ)) != 0;
}
inline Vec reciprocal(Vec x) { return (Vec)_mm256_rcp_ps((__m256)x); }
#elif defined(__SSE2__)
inline Vec min(Vec a, Vec b) { return (Vec)_mm_min_ps((__m128)a, (__m128)b); }
inline Vec max(Vec a, Vec b) { return (Vec)_mm_max_ps((__m128)a, (__m128)b); }
inline Vec sqrt(Vec a) { return (Vec)_mm_sqrt_ps((__m128)a); }
inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm_unpacklo_ps((__m128)a, (__m128)b); }
inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm_unpackhi_ps((__m128)a, (__m128)b); }
inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm_shuffle_ps((__m128)a, (__m128)b, 0x44); }
inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm_shuffle_ps((__m128)a, (__m128)b, 0xee); }
inline Vec select_ge(Vec x, Vec limit, Vec value) {
    return (Vec)_mm_and_ps(_mm_cmpge_ps((__m128)x, (__m128)limit), (__m128)value);
}
inline bool any_ge(Vec x, Vec limit) { return _mm_movemask_ps(_mm_cmpge_ps((__m128)x, (__m128)limit)) != 0; }
inline Vec reciprocal(Vec x) { return (Vec)_mm_rcp_ps((__m128)x); }
#elif defined(SPIKED_NEON)
// As on the other machines b where either is NaN, which NEON's own minimum does not give.
inline Vec min(Vec a, Vec b) { return (Vec)vbslq_f32(vcltq_f32(a, b), a, b); }
inline Vec max(Vec a, Vec b) { return (Vec)vbslq_f32(vcgtq_f32(a, b), a, b); }
inline Vec sqrt(Vec a) { return (Vec)vsqrtq_f32(a); }
inline Vec select_ge(Vec x, Vec limit, Vec value) {
    return (Vec)vandq_u32(vcgeq_f32(x, limit), vreinterpretq_u32_f32(value));
}
inline bool any_ge(Vec x, Vec limit) { return vmaxvq_u32(vcgeq_f32(x, limit)) != 0; }
inline Vec reciprocal(Vec x) {
    const float32x4_t rough = vrecpeq_f32(x);  // eight bits
    return (Vec)vmulq_f32(rough, vrecpsq_f32(x, rough));
}
#else
inline Vec min(Vec a, Vec b) { return a < b ? a : b; }
inline Vec max(Vec a, Vec b) { return a > b ? a : b; }
inline Vec sqrt(Vec a) {
    for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
    return a;
}
inline Vec select_ge(Vec x, Vec limit, Vec value) { return x >= limit ? value : Vec{}; }
inline bool any_ge(Vec x, Vec limit) {
    Int reached = x >= limit;
    bool any = false;
    for (int i = 0; i < kLanes; ++i) any |= reached[i] != 0;
    return any;
}
inline Vec reciprocal(Vec x) { return 1.0f / x; }
#endif

#if defined(__SSE2__)
// In each 128 bits: the sums over those 128 bits of v[0], v[1], v[2] and v[3].
inline Vec interleaved_sum(const Vec* v) {
    const Vec a = unpack_low(v[0], v[1]) + unpack_high(v[0], v[1]),
              b = unpack_low(v[2], v[3]) + unpack_high(v[2], v[3]);
    return low_pairs(a, b) + high_pairs(a, b);
}
#elif defined(SPIKED_NEON)
inline Vec interleaved_sum(const Vec* v) { return (Vec)vpaddq_f32(vpaddq_f32(v[0], v[1]), vpaddq_f32(v[2], v[3])); }
#endif

// x / y to about 1e-7, if y is not tiny.
inline Vec quotient(Vec x, Vec y) {
    const Vec over = reciprocal(y), rough = x * over;
    return rough + rough * (1.0f - y * over);
}

inline Vec clamp(Vec x, Vec low, Vec high) { return min(max(x, low), high); }
inline Vec select(Int condition, Vec yes, Vec no) { return condition ? yes : no; }
inline Int is_finite(Vec x) { return (x - x) == 0.0f; }

// 2^x for x >= -126, and anything at all below, from the polynomial p of 2^f on [0, 1), f the fractional part of x.
template <class Polynomial>
inline Vec exp2_by(Vec x, Polynomial p) {
#if defined(SPIKED_AVX512_FLOATS)
    Vec f = (Vec)_mm512_reduce_ps((__m512)x, _MM_FROUND_TO_NEG_INF);
    return (Vec)_mm512_scalef_ps((__m512)p(f), (__m512)x);
#else
    const Vec shift = broadcast(12582912.0f);  // 1.5 * 2^23: adding it leaves the rounded integer in the low bits
    Vec shifted = (x - 0.5f) + shift;
    Vec f = x - (shifted - shift);
    return (Vec)(bits(p(f)) + (bits(shifted) << 23));
#endif
}

// Relative error 2.6e-6, minimax fit.
inline Vec exp2_fast(Vec x) {
    return exp2_by(x, [](Vec f) {
        return 1.0000026226f + f * (0.6930038332939148f +
                                    f * (0.2414426952600479f + f * (0.05201161280274391f + f * 0.013534064404666424f)));
    });
}

// Relative error 1e-7, minimax fit; any x up to 127.
inline Vec exp2_fine(Vec x) {
    return exp2_by(max(x, broadcast(-126.0f)), [](Vec f) {
        return 0.9999999403953552f +
               f * (0.6931530833244324f +
                    f * (0.24015362560749054f +
                         f * (0.055826298892498016f + f * (0.008989361114799976f + f * 0.0018775691278278828f))));
    });
}

// log2 of a positive normal number: the series of atanh about the nearest power of two.
inline Vec log2_fine(Vec x) {
    Int e = (bits(x) - 0x3f3504f3) >> 23;
    Vec m = (Vec)(bits(x) - (e << 23));
    Vec s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    Vec series =
        s * (2.885390082f + s2 * (0.961796694f + s2 * (0.577078016f + s2 * (0.412198583f + s2 * 0.320598898f))));
    return __builtin_convertvector(e, Vec) + series;
}

}  // namespace
}  // namespace spiked
