// Compositing of one tile, forward and backward. A tile's pixels are kept block by block; a block is
// kParts native vectors.

constexpr int kParts = 16 / kLanes;
static_assert(kParts <= kMaxParts, "TileState::ends has room for every part");

constexpr float kLog2Cap = -0.014499570f;  // log2(0.99)

// The same numbers for every tile: offsets of the pixel centres, in tile order.
struct Centres {
    alignas(64) float x[kTilePixels], y[kTilePixels];
    constexpr Centres() : x(), y() {
        for (int i = 0; i < kTilePixels; ++i) {
            x[i] = (float)((i / 16 % 4) * 4 + i % 4) + 0.5f;
            y[i] = (float)((i / 64) * 4 + i / 4 % 4) + 0.5f;
        }
    }
};
static constexpr Centres kCentres;

// What the inner loops read of an entry. u = p x + q y + s and w = r y + t for a pixel centre (x, y) in the tile.
enum Local { kP, kQ, kS, kR, kT, kLog2Opacity, kZ, kC };
constexpr int local_floats(int colours) { return colours == 1 ? 8 : 16; }

constexpr int kAhead = 12;  // entries; covers the latency of main memory

template <int C>
static void localise(const Tile& tile) {
    float* out = tile.local;
    const float left = (float)(tile.tile_x * kTile), top = (float)(tile.tile_y * kTile);
    for (int i = 0; i < tile.count; ++i, out += local_floats(C)) {
        const Record& in = tile.records[tile.entries[i].rank];
        // Records lie in order of depth, so those of a tile are far apart.
        if (i + kAhead < tile.count) __builtin_prefetch(&tile.records[tile.entries[i + kAhead].rank]);
        out[kP] = in.p, out[kQ] = in.q, out[kR] = in.r;
        out[kS] = -(in.p * (in.x - left) + in.q * (in.y - top));
        out[kT] = -in.r * (in.y - top);
        out[kLog2Opacity] = in.log2_opacity;
        out[kZ] = in.z;
        for (int k = 0; k < C; ++k) out[kC + k] = in.colour[k];
        tile.blocks[i] = (uint16_t)tile.entries[i].blocks;
    }
    for (int i = 0; i < kGroup; ++i) tile.blocks[tile.count + i] = 0;
}

// Lists the entries that reach a block; writes up to kGroup places beyond what it keeps.
static inline int list_block(const Tile& tile, int block) {
    int listed = 0;
#if defined(__AVX512F__)
    __m512i number = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    const __m256i bit = _mm256_set1_epi16((short)(1 << block));
    for (int i = 0; i < tile.count; i += kGroup) {
        const __mmask16 kept = _mm256_test_epi16_mask(_mm256_loadu_si256((const __m256i*)(tile.blocks + i)), bit);
        // Compressed in a register: straight to memory is slow on some machines.
        _mm512_storeu_si512(tile.listed + listed, _mm512_maskz_compress_epi32(kept, number));
        listed += __builtin_popcount(kept);
        number = _mm512_add_epi32(number, _mm512_set1_epi32(kGroup));
    }
#else
    for (int i = 0; i < tile.count; ++i) {
        tile.listed[listed] = i;
        listed += tile.blocks[i] >> block & 1;
    }
#endif
    return listed;
}

static inline int part_x(const Tile& tile, int block) { return tile.tile_x * kTile + block % 4 * 4; }
static inline int part_y(const Tile& tile, int block) { return tile.tile_y * kTile + block / 4 * 4; }

// Calls visit(index in tile order, x, y, pixels) for each run of up to four pixels of the tile that lies in the image.
template <class Visit>
static inline void each_run(const Tile& tile, Visit visit) {
    for (int block = 0; block < kBlocks; ++block) {
        int x = part_x(tile, block), pixels = tile.lens->width - x;
        if (pixels > 4) pixels = 4;
        for (int row = 0; row < 4; ++row) {
            int y = part_y(tile, block) + row;
            if (y < tile.lens->height && pixels > 0) visit(block * 16 + row * 4, x, y, pixels);
        }
    }
}

static inline float weight_at(const Planes& planes, const Lens& lens, int x, int y) {
    return planes.weight ? planes.weight[(int64_t)y * lens.width + x] : planes.uniform_weight;
}

template <int C>
static void forward_tile(const Tile& tile, const float background[3], const Planes& planes, const TileState& state,
                         TileImage* image) {
    localise<C>(tile);
    alignas(64) float transmittance[kTilePixels] = {}, depth[kTilePixels] = {}, weight[kTilePixels] = {};
    each_run(tile, [&](int i, int x, int y, int pixels) {
        for (int j = 0; j < pixels; ++j) {
            transmittance[i + j] = 1.0f;
            weight[i + j] = weight_at(planes, *tile.lens, x + j, y);
        }
    });
    const Vec cut = splat(-kLog2Cut), cap = splat(0.99f), stop = splat(kStopTransmittance);
    for (int block = 0; block < kBlocks; ++block) {
        const int listed = list_block(tile, block);
        for (int part = 0; part < kParts; ++part) {
            const int at = block * 16 + part * kLanes;
            const Vec x = load(kCentres.x + at), y = load(kCentres.y + at);
            Vec t = load(transmittance + at), d{}, c[C] = {};
            int32_t end = tile.count;
            for (int i = 0; i < listed; ++i) {
                const float* s = tile.local + tile.listed[i] * local_floats(C);
                Vec u = s[kP] * x + (s[kQ] * y + s[kS]), w = s[kR] * y + s[kT];
                Vec log2_alpha = (s[kLog2Opacity] - u * u) - w * w;
                Vec alpha = min(where_reaches(log2_alpha, cut, exp2_fast(log2_alpha)), cap);
                Vec share = alpha * t;
                t -= share;
                d += share * s[kZ];
                for (int k = 0; k < C; ++k) c[k] += share * s[kC + k];
                if ((i & 3) == 3 && !any_reaches(t, stop)) {
                    end = tile.listed[i] + 1;
                    break;
                }
            }
            state.ends[block * kParts + part] = end;
            store(transmittance + at, t);
            store(depth + at, d);
            for (int k = 0; k < C; ++k) store(state.colour + k * kTilePixels + at, c[k] + background[k] * t);
        }
    }
    for (int i = 0; i < kTilePixels; ++i) {
        image->weight[i] += weight[i];
        image->alpha[i] += weight[i] * (1.0f - transmittance[i]);
        image->depth[i] += weight[i] * depth[i];
        for (int k = 0; k < C; ++k) image->value[k][i] += weight[i] * state.colour[k * kTilePixels + i];
    }
}

static void store_tile(const Tile& tile, const TileImage* image, int colours, const Planes& planes, float* values,
                       float* alpha, float* depth) {
    each_run(tile, [&](int i, int x, int y, int pixels) {
        for (int j = 0; j < pixels; ++j) {
            const int64_t at = (int64_t)y * tile.lens->width + x + j;
            const int k = i + j;
            if (colours == 1 || planes.channels) {
                values[at] = image->value[colours == 1 ? 0 : planes.channels[at]][k];
            } else {
                for (int c = 0; c < 3; ++c) values[3 * at + c] = image->value[c][k];
            }
            alpha[at] = image->weight[k] > 0 ? image->alpha[k] / image->weight[k] : 0;
            depth[at] = image->alpha[k] > 0 ? image->depth[k] / image->alpha[k] : 0;
        }
    });
}

// out[i] = the sum of v[i]'s lanes, for i < N; N is 8 or 4. The lanes are added as a tree, N sums at a time.
template <int N>
static inline void totals(const Vec* v, float* out) {
#if defined(__SSE2__)
    Vec quads[2];  // in each 128 bits, the sums of four vectors over those 128 bits
    for (int i = 0; i < N / 4; ++i) quads[i] = interleaved_sum(v + 4 * i);
#if defined(__AVX512F__)
    const __m512 a = (__m512)quads[0], b = (__m512)quads[N / 4 - 1];
    const __m512 halves = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
    const __m512 sums = _mm512_add_ps(halves, _mm512_shuffle_f32x4(halves, halves, 0xb1));
    _mm_storeu_ps(out, _mm512_castps512_ps128(sums));
    if (N == 8) _mm_storeu_ps(out + 4, _mm512_extractf32x4_ps(sums, 2));
#elif defined(__AVX2__)
    for (int i = 0; i < N / 4; ++i) {
        const __m256 a = (__m256)quads[i];
        _mm_storeu_ps(out + 4 * i, _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1)));
    }
#else
    for (int i = 0; i < N / 4; ++i) store(out + 4 * i, quads[i]);
#endif
#else
    for (int i = 0; i < N; ++i) {
        out[i] = 0;
        for (int lane = 0; lane < kLanes; ++lane) out[i] += v[i][lane];
    }
#endif
}

// The state that a tile's pixels carry from splat to splat: transmittance, and what is still to come of the sum over
// colours of d_value times value.
template <int C>
struct Pixels {
    alignas(64) float t[kTilePixels], rest[kTilePixels], d[C][kTilePixels];
};

// Sums of one entry over its blocks. Capped: the splat is opaque enough to reach the cap, where alpha has no gradient.
template <int C, bool Capped>
static inline void backward_entry(const float* s, uint32_t blocks, int index, const int32_t* ends, Pixels<C>& pixels,
                                  float* slot) {
    const Vec cut = splat(-kLog2Cut), cap = splat(0.99f);
    Vec sum[kColour0 + C] = {};
    for (; blocks; blocks &= blocks - 1) {
        const int block = __builtin_ctz(blocks);
        for (int part = 0; part < kParts; ++part) {
            if (kParts > 1 && index >= ends[block * kParts + part]) continue;
            const int at = block * 16 + part * kLanes;
            const Vec x = load(kCentres.x + at), y = load(kCentres.y + at);
            Vec u = s[kP] * x + (s[kQ] * y + s[kS]), w = s[kR] * y + s[kT];
            Vec log2_alpha = (s[kLog2Opacity] - u * u) - w * w;
            Vec alpha = where_reaches(log2_alpha, cut, exp2_fast(log2_alpha));
            if (Capped) alpha = min(alpha, cap);
            Vec t = load(pixels.t + at), rest = load(pixels.rest + at);
            Vec share = alpha * t, d = s[kC] * load(pixels.d[0] + at);
            for (int k = 1; k < C; ++k) d += s[kC + k] * load(pixels.d[k] + at);
            Vec shown = share * d;
            rest -= shown;
            store(pixels.t + at, t - share);
            store(pixels.rest + at, rest);
            Vec v = shown - rest * (reciprocal(1.0f - alpha) * alpha);
            if (Capped) v = where_reaches(splat(kLog2Cap), log2_alpha, v);
            Vec vu = v * u, vw = v * w;
            sum[kV] += v;
            sum[kVu] += vu;
            sum[kVw] += vw;
            sum[kVuu] += vu * u;
            sum[kVuw] += vu * w;
            sum[kVww] += vw * w;
            sum[kShare] += share;
            for (int k = 0; k < C; ++k) sum[kColour0 + k] += share * load(pixels.d[k] + at);
        }
    }
    totals<8>(sum, slot);
    if (C == 3) {
        Vec more[4] = {sum[kColour0 + 1], sum[kColour0 + C - 1], Vec{}, Vec{}};
        totals<4>(more, slot + 8);
    }
}

template <int C>
static void backward_tile(const Tile& tile, const float* d_values, const Planes& planes, const TileState& state,
                          float* slots) {
    localise<C>(tile);
    Pixels<C> pixels = {};
    each_run(tile, [&](int i, int x, int y, int run) {
        for (int j = 0; j < run; ++j) {
            const int64_t at = (int64_t)y * tile.lens->width + x + j;
            const float weight = weight_at(planes, *tile.lens, x + j, y);
            pixels.t[i + j] = 1.0f;
            for (int k = 0; k < C; ++k) {
                float d = C == 1 || planes.channels ? d_values[at] : d_values[3 * at + k];
                if (C > 1 && planes.channels && planes.channels[at] != k) d = 0;
                pixels.d[k][i + j] = d * weight;
                pixels.rest[i + j] += d * weight * state.colour[k * kTilePixels + i + j];
            }
        }
    });
#if defined(__AVX512F__)
    const __m512i ends = _mm512_loadu_si512(state.ends);
#endif
    const float* s = tile.local;
    for (int i = 0; i < tile.count; ++i, s += local_floats(C)) {
        uint32_t blocks = tile.entries[i].blocks;
#if defined(__AVX512F__)
        blocks &= _mm512_cmpgt_epi32_mask(ends, _mm512_set1_epi32(i));
#endif
        float* slot = slots + (int64_t)tile.entries[i].slot * slot_floats(C);
        if (s[kLog2Opacity] > kLog2Cap) {
            backward_entry<C, true>(s, blocks, i, state.ends, pixels, slot);
        } else {
            backward_entry<C, false>(s, blocks, i, state.ends, pixels, slot);
        }
    }
}

static void forward(const Tile& tile, int colours, const float background[3], const Planes& planes,
                    const TileState& state, TileImage* image) {
    if (colours == 1) return forward_tile<1>(tile, background, planes, state, image);
    forward_tile<3>(tile, background, planes, state, image);
}

static void backward(const Tile& tile, int colours, const float* d_values, const Planes& planes, const TileState& state,
                     float* slots) {
    if (colours == 1) return backward_tile<1>(tile, d_values, planes, state, slots);
    backward_tile<3>(tile, d_values, planes, state, slots);
}
