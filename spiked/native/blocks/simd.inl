// The few vector operations that the kernels need, for the instruction set this file is compiled for. A `vec` holds one
// byte a pixel; shifts and bit tricks go through 64-bit lanes because no instruction set shifts bytes.
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__AVX2__)
#include <immintrin.h>
#elif defined(SPIKED_NEON)
#include <arm_neon.h>
#endif

namespace {

#if defined(__AVX512BITALG__) && defined(__GFNI__)
constexpr int kWidth = 64;
#elif defined(__AVX2__)
constexpr int kWidth = 32;
#else
constexpr int kWidth = 16;
#endif

typedef uint8_t vec __attribute__((vector_size(kWidth)));
typedef uint64_t lanes __attribute__((vector_size(kWidth)));

inline vec splat(uint8_t value) { return vec{} + value; }

inline vec load(const uint8_t* from) {
    vec v;
    memcpy(&v, from, sizeof v);
    return v;
}

// Stores the first `room` bytes if there is no room for all; rows are multiples of eight pixels.
inline void store(uint8_t* to, vec v, size_t room) {
    if (room >= sizeof v) {
        memcpy(to, &v, sizeof v);
        return;
    }
#if defined(__AVX512BITALG__) && defined(__GFNI__)
    _mm512_mask_storeu_epi8(to, (uint64_t{1} << room) - 1, (__m512i)v);
#else
    const uint8_t* from = reinterpret_cast<const uint8_t*>(&v);
    for (size_t i = 0; i < room; i += 8) memcpy(to + i, from + i, 8);
#endif
}

// Half as many pixels with two bytes each; comparisons give 0 or 0xFFFF.
typedef uint16_t wide __attribute__((vector_size(kWidth)));

inline wide load_wide(const uint16_t* from) {
    wide v;
    memcpy(&v, from, sizeof v);
    return v;
}

inline void store_wide(uint16_t* to, wide v, size_t room) { store(reinterpret_cast<uint8_t*>(to), (vec)v, room); }

// Half a vector of bytes to two bytes each.
inline wide load_widened(const uint8_t* from) {
    typedef uint8_t half __attribute__((vector_size(kWidth / 2)));
    half v;
    memcpy(&v, from, sizeof v);
    return __builtin_convertvector(v, wide);
}

inline wide choose(wide mask, wide yes, wide no) { return (yes & mask) | (no & ~mask); }

inline vec is_zero(vec v) { return (vec)(v == 0); }
inline vec low_nibble(vec v) { return v & 0x0F; }
inline vec high_nibble(vec v) { return (vec)((lanes)v >> 4) & 0x0F; }

#if defined(__AVX512BITALG__) && defined(__GFNI__)

inline vec smaller(vec a, vec b) { return (vec)_mm512_min_epu8((__m512i)a, (__m512i)b); }
inline vec larger(vec a, vec b) { return (vec)_mm512_max_epu8((__m512i)a, (__m512i)b); }
inline vec popcount(vec h) { return (vec)_mm512_popcnt_epi8((__m512i)h); }
inline vec lookup(__m128i table, vec nibble) {
    return (vec)_mm512_shuffle_epi8(_mm512_broadcast_i32x4(table), (__m512i)nibble);
}

#elif defined(__AVX2__)

inline vec smaller(vec a, vec b) { return (vec)_mm256_min_epu8((__m256i)a, (__m256i)b); }
inline vec larger(vec a, vec b) { return (vec)_mm256_max_epu8((__m256i)a, (__m256i)b); }
inline vec lookup(__m128i table, vec nibble) {
    return (vec)_mm256_shuffle_epi8(_mm256_broadcastsi128_si256(table), (__m256i)nibble);
}
inline vec popcount(vec h) {
    const __m128i bits = _mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
    return lookup(bits, low_nibble(h)) + lookup(bits, high_nibble(h));
}

#else

inline vec smaller(vec a, vec b) { return a < b ? a : b; }
#if defined(SPIKED_NEON)
inline vec popcount(vec h) { return (vec)vcntq_u8((uint8x16_t)h); }
#else
inline vec popcount(vec h) {
    h -= (vec)((lanes)h >> 1) & 0x55;
    h = (h & 0x33) + ((vec)((lanes)h >> 2) & 0x33);
    return low_nibble(h + (vec)((lanes)h >> 4));
}
#endif

// Index of the only set bit of each byte.
inline vec bit_index(vec one) {
    return (~is_zero(one & 0xAA) & 1) | (~is_zero(one & 0xCC) & 2) | (~is_zero(one & 0xF0) & 4);
}

#endif

#if defined(__AVX512BITALG__) && defined(__GFNI__)

// Number of zero bits below the lowest set bit, 8 where there is none.
inline vec trailing_zeros(vec h) { return popcount(~h & (h - 1)); }

// Index of the lowest set bit of each byte, kNever8 where there is none.
inline vec lowest(vec h) { return trailing_zeros(h) | is_zero(h); }

// Index of the highest set bit of each byte, kNever8 where there is none.
inline vec highest(vec h) {
    const __m512i reverse = _mm512_set1_epi64(static_cast<int64_t>(0x8040201008040201));
    return 7 - trailing_zeros((vec)_mm512_gf2p8affine_epi64_epi8((__m512i)h, reverse, 0));
}

#elif defined(__AVX2__)

// Index of the lowest set bit of each byte, kNever8 where there is none.
inline vec lowest(vec h) {
    const __m128i low = _mm_setr_epi8(-1, 0, 1, 0, 2, 0, 1, 0, 3, 0, 1, 0, 2, 0, 1, 0);
    const __m128i high = _mm_setr_epi8(-1, 4, 5, 4, 6, 4, 5, 4, 7, 4, 5, 4, 6, 4, 5, 4);
    return smaller(lookup(low, low_nibble(h)), lookup(high, high_nibble(h)));
}

// Index of the highest set bit of each byte, kNever8 where there is none.
inline vec highest(vec h) {
    const __m128i low = _mm_setr_epi8(0, 1, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4, 4, 4, 4);
    const __m128i high = _mm_setr_epi8(0, 5, 6, 6, 7, 7, 7, 7, 8, 8, 8, 8, 8, 8, 8, 8);
    return larger(lookup(low, low_nibble(h)), lookup(high, high_nibble(h))) - 1;
}

#else

#if defined(SPIKED_NEON)
// Leading zeros are 8 for none; turned around, those of the reversed byte are the trailing ones.
inline vec lowest(vec h) { return (vec)vclzq_u8(vrbitq_u8((uint8x16_t)h)) | is_zero(h); }
inline vec highest(vec h) { return 7 - (vec)vclzq_u8((uint8x16_t)h); }
#else
inline vec lowest(vec h) { return bit_index(h & -h) | is_zero(h); }

inline vec highest(vec h) {
    vec smeared = h | ((vec)((lanes)h >> 1) & 0x7F);
    smeared |= (vec)((lanes)smeared >> 2) & 0x3F;
    smeared |= high_nibble(smeared);
    return popcount(smeared) - 1;
}
#endif

#endif

#if defined(__AVX512BITALG__) && defined(__GFNI__)

inline __m512i low8(__m512i a, __m512i b) { return _mm512_unpacklo_epi8(a, b); }
inline __m512i high8(__m512i a, __m512i b) { return _mm512_unpackhi_epi8(a, b); }
inline __m512i low16(__m512i a, __m512i b) { return _mm512_unpacklo_epi16(a, b); }
inline __m512i high16(__m512i a, __m512i b) { return _mm512_unpackhi_epi16(a, b); }
inline __m512i low32(__m512i a, __m512i b) { return _mm512_unpacklo_epi32(a, b); }
inline __m512i high32(__m512i a, __m512i b) { return _mm512_unpackhi_epi32(a, b); }
typedef __m512i bytes;

#elif defined(__AVX2__)

inline __m256i low8(__m256i a, __m256i b) { return _mm256_unpacklo_epi8(a, b); }
inline __m256i high8(__m256i a, __m256i b) { return _mm256_unpackhi_epi8(a, b); }
inline __m256i low16(__m256i a, __m256i b) { return _mm256_unpacklo_epi16(a, b); }
inline __m256i high16(__m256i a, __m256i b) { return _mm256_unpackhi_epi16(a, b); }
inline __m256i low32(__m256i a, __m256i b) { return _mm256_unpacklo_epi32(a, b); }
inline __m256i high32(__m256i a, __m256i b) { return _mm256_unpackhi_epi32(a, b); }
typedef __m256i bytes;

#else

typedef uint32_t vec32 __attribute__((vector_size(kWidth)));
typedef vec bytes;
inline vec low8(vec a, vec b) {
    return __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
}
inline vec high8(vec a, vec b) {
    return __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
}
inline vec low16(vec a, vec b) { return (vec)__builtin_shufflevector((wide)a, (wide)b, 0, 8, 1, 9, 2, 10, 3, 11); }
inline vec high16(vec a, vec b) { return (vec)__builtin_shufflevector((wide)a, (wide)b, 4, 12, 5, 13, 6, 14, 7, 15); }
inline vec low32(vec a, vec b) { return (vec)__builtin_shufflevector((vec32)a, (vec32)b, 0, 4, 1, 5); }
inline vec high32(vec a, vec b) { return (vec)__builtin_shufflevector((vec32)a, (vec32)b, 2, 6, 3, 7); }

#endif

// Eight vectors a_0..a_7 to their bytes in the order a_0[0] a_1[0] .. a_7[0] a_0[1] .., within each 128-bit lane.
inline void interleave(const bytes in[8], bytes out[8]) {
    const bytes a0 = low8(in[0], in[1]), a1 = high8(in[0], in[1]);
    const bytes b0 = low8(in[2], in[3]), b1 = high8(in[2], in[3]);
    const bytes c0 = low8(in[4], in[5]), c1 = high8(in[4], in[5]);
    const bytes d0 = low8(in[6], in[7]), d1 = high8(in[6], in[7]);
    const bytes ab[4] = {low16(a0, b0), high16(a0, b0), low16(a1, b1), high16(a1, b1)};
    const bytes cd[4] = {low16(c0, d0), high16(c0, d0), low16(c1, d1), high16(c1, d1)};
    for (int i = 0; i < 4; ++i) {
        out[2 * i] = low32(ab[i], cd[i]);
        out[2 * i + 1] = high32(ab[i], cd[i]);
    }
}

#if defined(__AVX512BITALG__) && defined(__GFNI__)

// kWidth bytes of each of eight frames to 8 * kWidth history bytes, one a pixel in image order: bit f is frame f.
inline void histories(const uint8_t* const* frames, size_t at, bool msb, vec out[8]) {
    // Lane l of the interleaved vector k shall hold byte columns 8 k + 2 l and 8 k + 2 l + 1.
    const __m512i spread = _mm512_set_epi16(31, 27, 23, 19, 15, 11, 7, 3, 30, 26, 22, 18, 14, 10, 6, 2,  //
                                            29, 25, 21, 17, 13, 9, 5, 1, 28, 24, 20, 16, 12, 8, 4, 0);
    // A 64-bit lane times the unit vectors is its transpose; the order of the unit vectors is the bit order.
    const __m512i units = _mm512_set1_epi64(msb ? 0x0102040810204080 : static_cast<int64_t>(0x8040201008040201));
    bytes rows[8], columns[8];
    // The affine instruction counts matrix rows from the last byte of the lane, so frame 7 goes first.
    for (int f = 0; f < 8; ++f) rows[7 - f] = _mm512_permutexvar_epi16(spread, _mm512_loadu_si512(frames[f] + at));
    interleave(rows, columns);
    for (int i = 0; i < 8; ++i) out[i] = (vec)_mm512_gf2p8affine_epi64_epi8(units, columns[i], 0);
}

#else

// One stage of the transpose of eight 8x8 bit matrices whose rows lie in eight vectors.
template <int kShift>
inline void swap_bits(vec& a, vec& b, uint8_t mask) {
    const vec t = ((vec)((lanes)a >> kShift) ^ b) & mask;
    b ^= t;
    a ^= (vec)((lanes)t << kShift);
}

// kWidth bytes of each of eight frames to 8 * kWidth history bytes, one a pixel in image order: bit f is frame f.
inline void histories(const uint8_t* const* frames, size_t at, bool msb, vec out[8]) {
    vec m[8];
    for (int f = 0; f < 8; ++f) m[f] = load(frames[f] + at);
    for (int i = 0; i < 4; ++i) swap_bits<4>(m[i], m[i + 4], 0x0F);
    for (int i = 0; i < 4; ++i) swap_bits<2>(m[i + (i & 2)], m[i + (i & 2) + 2], 0x33);
    for (int i = 0; i < 8; i += 2) swap_bits<1>(m[i], m[i + 1], 0x55);
    bytes columns[8], ordered[8];
    for (int i = 0; i < 8; ++i) columns[i] = (bytes)m[msb ? 7 - i : i];
    interleave(columns, ordered);
#if defined(__AVX2__)
    for (int i = 0; i < 4; ++i) {
        out[i] = (vec)_mm256_permute2x128_si256(ordered[2 * i], ordered[2 * i + 1], 0x20);
        out[i + 4] = (vec)_mm256_permute2x128_si256(ordered[2 * i], ordered[2 * i + 1], 0x31);
    }
#else
    for (int i = 0; i < 8; ++i) out[i] = ordered[i];
#endif
}

#endif

}  // namespace
