// One native vector of floats and the few operations that the kernels need, for the instruction set being compiled.
// GCC splits vector types that are wider than the machine's into scalars, so a block of 16 pixels is
// kGroup / kLanes native vectors, never one wide type.

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Vec __attribute__((vector_size(kLanes * 4)));
typedef int32_t Int __attribute__((vector_size(kLanes * 4)));

static inline Vec splat(float x) { return x - Vec{}; }
static inline Vec load(const float* p) {
    Vec v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
static inline void store(float* p, Vec v) { __builtin_memcpy(p, &v, sizeof v); }
static inline Int bits(Vec v) { return (Int)v; }

#if defined(__AVX512F__)
static inline Vec min(Vec a, Vec b) { return (Vec)_mm512_min_ps((__m512)a, (__m512)b); }
static inline Vec max(Vec a, Vec b) { return (Vec)_mm512_max_ps((__m512)a, (__m512)b); }
static inline Vec root(Vec a) { return (Vec)_mm512_sqrt_ps((__m512)a); }
static inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm512_unpacklo_ps((__m512)a, (__m512)b); }
static inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm512_unpackhi_ps((__m512)a, (__m512)b); }
static inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm512_shuffle_ps((__m512)a, (__m512)b, 0x44); }
static inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm512_shuffle_ps((__m512)a, (__m512)b, 0xee); }
// value where x >= limit, else 0; for NaN 0.
static inline Vec where_reaches(Vec x, Vec limit, Vec value) {
    return (Vec)_mm512_maskz_mov_ps(_mm512_cmp_ps_mask((__m512)x, (__m512)limit, _CMP_GE_OQ), (__m512)value);
}
static inline bool any_reaches(Vec x, Vec limit) {
    return _mm512_cmp_ps_mask((__m512)x, (__m512)limit, _CMP_GE_OQ) != 0;
}
// 1 / x, roughly.
static inline Vec reciprocal(Vec x) { return (Vec)_mm512_rcp14_ps((__m512)x); }
#elif defined(__AVX2__)
static inline Vec min(Vec a, Vec b) { return (Vec)_mm256_min_ps((__m256)a, (__m256)b); }
static inline Vec max(Vec a, Vec b) { return (Vec)_mm256_max_ps((__m256)a, (__m256)b); }
static inline Vec root(Vec a) { return (Vec)_mm256_sqrt_ps((__m256)a); }
static inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm256_unpacklo_ps((__m256)a, (__m256)b); }
static inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm256_unpackhi_ps((__m256)a, (__m256)b); }
static inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm256_shuffle_ps((__m256)a, (__m256)b, 0x44); }
static inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm256_shuffle_ps((__m256)a, (__m256)b, 0xee); }
static inline Vec where_reaches(Vec x, Vec limit, Vec value) {
    return (Vec)_mm256_and_ps(_mm256_cmp_ps((__m256)x, (__m256)limit, _CMP_GE_OQ), (__m256)value);
}
static inline bool any_reaches(Vec x, Vec limit) {
    return _mm256_movemask_ps(_mm256_cmp_ps((__m256)x, (__m256)limit, _CMP_GE_OQ)) != 0;
}
static inline Vec reciprocal(Vec x) { return (Vec)_mm256_rcp_ps((__m256)x); }
#elif defined(__SSE2__)
static inline Vec min(Vec a, Vec b) { return (Vec)_mm_min_ps((__m128)a, (__m128)b); }
static inline Vec max(Vec a, Vec b) { return (Vec)_mm_max_ps((__m128)a, (__m128)b); }
static inline Vec root(Vec a) { return (Vec)_mm_sqrt_ps((__m128)a); }
static inline Vec unpack_low(Vec a, Vec b) { return (Vec)_mm_unpacklo_ps((__m128)a, (__m128)b); }
static inline Vec unpack_high(Vec a, Vec b) { return (Vec)_mm_unpackhi_ps((__m128)a, (__m128)b); }
static inline Vec low_pairs(Vec a, Vec b) { return (Vec)_mm_shuffle_ps((__m128)a, (__m128)b, 0x44); }
static inline Vec high_pairs(Vec a, Vec b) { return (Vec)_mm_shuffle_ps((__m128)a, (__m128)b, 0xee); }
static inline Vec where_reaches(Vec x, Vec limit, Vec value) {
    return (Vec)_mm_and_ps(_mm_cmpge_ps((__m128)x, (__m128)limit), (__m128)value);
}
static inline bool any_reaches(Vec x, Vec limit) {
    return _mm_movemask_ps(_mm_cmpge_ps((__m128)x, (__m128)limit)) != 0;
}
static inline Vec reciprocal(Vec x) { return (Vec)_mm_rcp_ps((__m128)x); }
#elif defined(SPIKED_NEON)
// As on the other machines b where either is NaN, which NEON's own minimum does not give.
static inline Vec min(Vec a, Vec b) { return (Vec)vbslq_f32(vcltq_f32(a, b), a, b); }
static inline Vec max(Vec a, Vec b) { return (Vec)vbslq_f32(vcgtq_f32(a, b), a, b); }
static inline Vec root(Vec a) { return (Vec)vsqrtq_f32(a); }
static inline Vec where_reaches(Vec x, Vec limit, Vec value) {
    return (Vec)vandq_u32(vcgeq_f32(x, limit), vreinterpretq_u32_f32(value));
}
static inline bool any_reaches(Vec x, Vec limit) { return vmaxvq_u32(vcgeq_f32(x, limit)) != 0; }
static inline Vec reciprocal(Vec x) {
    const float32x4_t rough = vrecpeq_f32(x);  // eight bits
    return (Vec)vmulq_f32(rough, vrecpsq_f32(x, rough));
}
#else
static inline Vec min(Vec a, Vec b) { return a < b ? a : b; }
static inline Vec max(Vec a, Vec b) { return a > b ? a : b; }
static inline Vec root(Vec a) {
    for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
    return a;
}
static inline Vec where_reaches(Vec x, Vec limit, Vec value) { return x >= limit ? value : Vec{}; }
static inline bool any_reaches(Vec x, Vec limit) {
    Int reached = x >= limit;
    bool any = false;
    for (int i = 0; i < kLanes; ++i) any |= reached[i] != 0;
    return any;
}
static inline Vec reciprocal(Vec x) { return 1.0f / x; }
#endif

#if defined(__SSE2__)
// In each 128 bits: the sums over those 128 bits of v[0], v[1], v[2] and v[3].
static inline Vec interleaved_sum(const Vec* v) {
    const Vec a = unpack_low(v[0], v[1]) + unpack_high(v[0], v[1]),
              b = unpack_low(v[2], v[3]) + unpack_high(v[2], v[3]);
    return low_pairs(a, b) + high_pairs(a, b);
}
#elif defined(SPIKED_NEON)
static inline Vec interleaved_sum(const Vec* v) {
    return (Vec)vpaddq_f32(vpaddq_f32(v[0], v[1]), vpaddq_f32(v[2], v[3]));
}
#endif

// x / y to about 1e-7, if y is not tiny.
static inline Vec quotient(Vec x, Vec y) {
    const Vec over = reciprocal(y), rough = x * over;
    return rough + rough * (1.0f - y * over);
}

static inline Vec clamp(Vec x, Vec low, Vec high) { return min(max(x, low), high); }
static inline Vec choose(Int condition, Vec yes, Vec no) { return condition ? yes : no; }
static inline Int is_finite(Vec x) { return (x - x) == 0.0f; }

// 2^x for x >= -126, and anything at all below, from the polynomial p of 2^f on [0, 1), f the fractional part of x.
template <class Polynomial>
static inline Vec exp2_by(Vec x, Polynomial p) {
#if defined(__AVX512F__)
    Vec f = (Vec)_mm512_reduce_ps((__m512)x, _MM_FROUND_TO_NEG_INF);
    return (Vec)_mm512_scalef_ps((__m512)p(f), (__m512)x);
#else
    const Vec shift = splat(12582912.0f);  // 1.5 * 2^23: adding it leaves the rounded integer in the low bits
    Vec shifted = (x - 0.5f) + shift;
    Vec f = x - (shifted - shift);
    return (Vec)(bits(p(f)) + (bits(shifted) << 23));
#endif
}

// Relative error 2.6e-6, minimax fit.
static inline Vec exp2_fast(Vec x) {
    return exp2_by(x, [](Vec f) {
        return 1.0000026226f + f * (0.6930038332939148f +
                                    f * (0.2414426952600479f + f * (0.05201161280274391f + f * 0.013534064404666424f)));
    });
}

// Relative error 1e-7, minimax fit; any x up to 127.
static inline Vec exp2_fine(Vec x) {
    return exp2_by(max(x, splat(-126.0f)), [](Vec f) {
        return 0.9999999403953552f +
               f * (0.6931530833244324f +
                    f * (0.24015362560749054f +
                         f * (0.055826298892498016f + f * (0.008989361114799976f + f * 0.0018775691278278828f))));
    });
}

// log2 of a positive normal number: the series of atanh about the nearest power of two.
static inline Vec log2_fine(Vec x) {
    Int e = (bits(x) - 0x3f3504f3) >> 23;
    Vec m = (Vec)(bits(x) - (e << 23));
    Vec s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    Vec series =
        s * (2.885390082f + s2 * (0.961796694f + s2 * (0.577078016f + s2 * (0.412198583f + s2 * 0.320598898f))));
    return __builtin_convertvector(e, Vec) + series;
}
