// Compositing of one tile, forward and backward. A tile's pixels are kept block by block; a block is
// kParts native vectors.

namespace spiked {
namespace {

constexpr int kParts = 16 / kLanes;
static_assert(kParts <= kMaxParts, "TileState::ends has room for every part");

constexpr float kAlphaCap = 0.99f;         // largest opacity of a splat at a pixel, as in 3D Gaussian splatting
constexpr float kLog2Cap = -0.014499570f;  // log2(kAlphaCap)

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

// Offsets of the blocks of a tile.
struct BlockCorners {
    alignas(64) float x[kBlocks], y[kBlocks];
    constexpr BlockCorners() : x(), y() {
        for (int i = 0; i < kBlocks; ++i) {
            x[i] = (float)(i % 4 * 4);
            y[i] = (float)(i / 4 * 4);
        }
    }
};
static constexpr BlockCorners kBlockCorners;

// The fields of an entry that the inner loops read. u = p x + q y + s and w = r y + t for a pixel centre (x, y) in the
// tile. While the camera moves, u is smaller by u_rate times the pixel's time, and w by w_rate times it.
enum Local { kP, kQ, kS, kR, kT, kLog2Opacity, kZ, kC, kURate = kC + 3, kWRate };
constexpr int local_floats(int colours, bool moving) { return colours == 1 && !moving ? 8 : 16; }

constexpr int kAhead = 12;  // entries; covers the latency of main memory

template <int C, bool Moving>
static void localise(const Tile& tile) {
    float* out = tile.local;
    const float left = (float)(tile.tile_x * kTile), top = (float)(tile.tile_y * kTile);
    for (int i = 0; i < tile.count; ++i, out += local_floats(C, Moving)) {
        const ProjectedSplat& in = tile.records[tile.entries[i].rank];
        // Records lie in order of depth, so those of a tile are far apart.
        if (i + kAhead < tile.count) {
            __builtin_prefetch(&tile.records[tile.entries[i + kAhead].rank]);
            if (Moving) __builtin_prefetch(&tile.motions[tile.entries[i + kAhead].rank]);
        }
        if (Moving) {
            const Motion& motion = tile.motions[tile.entries[i].rank];
            out[kP] = motion.p, out[kQ] = motion.q, out[kR] = motion.r;
            out[kLog2Opacity] = motion.log2_opacity;
            out[kURate] = motion.u_rate, out[kWRate] = motion.w_rate;
        } else {
            out[kP] = in.p, out[kQ] = in.q, out[kR] = in.r;
            out[kLog2Opacity] = in.log2_opacity;
        }
        out[kS] = -(out[kP] * (in.x - left) + out[kQ] * (in.y - top));
        out[kT] = -out[kR] * (in.y - top);
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
        int x = part_x(tile, block), pixels = tile.camera->width - x;
        if (pixels > 4) pixels = 4;
        for (int row = 0; row < 4; ++row) {
            int y = part_y(tile, block) + row;
            if (y < tile.camera->height && pixels > 0) visit(block * 16 + row * 4, x, y, pixels);
        }
    }
}

// Weights of a tile's pixels, 0 outside of the image, and while the camera moves their times in the sub-frame.
template <bool Moving>
static inline void read_planes(const Tile& tile, const Planes& planes, float* weight, float* time) {
    each_run(tile, [&](int i, int x, int y, int pixels) {
        const int64_t at = (int64_t)y * tile.camera->width + x;
        for (int j = 0; j < pixels; ++j) {
            if (Moving) {
                const Covered covered = covered_by(planes, at + j);
                weight[i + j] = covered.weight;
                time[i + j] = covered.time;
            } else {
                weight[i + j] = planes.weight ? planes.weight[at + j] : planes.uniform_weight;
            }
        }
    });
}

// A bit for each block with a weight that is not 0.
static inline uint32_t weighted_blocks(const float* weight) {
    uint32_t blocks = 0;
    for (int block = 0; block < kBlocks; ++block) {
        float most = 0;
        for (int i = 0; i < 16; ++i) most = weight[16 * block + i] > most ? weight[16 * block + i] : most;
        blocks |= (uint32_t)(most > 0) << block;
    }
    return blocks;
}

template <int C, bool Moving>
static void forward_tile(const Tile& tile, const float background[3], const Planes& planes, const TileState& state,
                         TileImage* image) {
    localise<C, Moving>(tile);
    alignas(64) float transmittance[kTilePixels] = {}, depth[kTilePixels] = {}, weight[kTilePixels] = {};
    alignas(64) float time[Moving ? kTilePixels : 1] = {};
    read_planes<Moving>(tile, planes, weight, time);
    each_run(tile, [&](int i, int, int, int pixels) {
        for (int j = 0; j < pixels; ++j) transmittance[i + j] = 1.0f;
    });
    const uint32_t weighted = Moving ? weighted_blocks(weight) : 0xffff;
    const Vec cut = broadcast(-kLog2Cut), cap = broadcast(kAlphaCap), stop = broadcast(kStopTransmittance);
    for (int block = 0; block < kBlocks; ++block) {
        const int listed = weighted >> block & 1 ? list_block(tile, block) : 0;
        for (int part = 0; part < kParts; ++part) {
            const int at = block * 16 + part * kLanes;
            const Vec x = load(kCentres.x + at), y = load(kCentres.y + at);
            const Vec when = Moving ? load(time + at) : Vec{};
            Vec t = load(transmittance + at), d{}, c[C] = {};
            int32_t end = listed ? tile.count : 0;
            for (int i = 0; i < listed; ++i) {
                const float* s = tile.local + tile.listed[i] * local_floats(C, Moving);
                Vec u = s[kP] * x + (s[kQ] * y + s[kS]), w = s[kR] * y + s[kT];
                if (Moving) {
                    u -= s[kURate] * when;
                    w -= s[kWRate] * when;
                }
                Vec log2_alpha = (s[kLog2Opacity] - u * u) - w * w;
                Vec alpha = min(select_ge(log2_alpha, cut, exp2_fast(log2_alpha)), cap);
                Vec share = alpha * t;
                t -= share;
                d += share * s[kZ];
                for (int k = 0; k < C; ++k) c[k] += share * s[kC + k];
                if ((i & 3) == 3 && !any_ge(t, stop)) {
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

static inline void copy_run(float* out, const float* in, int pixels) {
    if (pixels == 4) {
        __builtin_memcpy(out, in, 4 * sizeof(float));
    } else {
        for (int j = 0; j < pixels; ++j) out[j] = in[j];
    }
}

static void store_tile(const Tile& tile, const TileImage* image, int colours, const Planes& planes, float* values,
                       float* alpha, float* depth) {
    alignas(64) float opacity[kTilePixels], distance[kTilePixels];
    for (int k = 0; k < kTilePixels; k += kLanes) {
        const Vec w = load(image->weight + k), a = load(image->alpha + k), d = load(image->depth + k);
        store(opacity + k, select(w > 0.0f, a / w, Vec{}));
        store(distance + k, select(a > 0.0f, d / a, Vec{}));
    }
    each_run(tile, [&](int k, int x, int y, int pixels) {
        const int64_t at = (int64_t)y * tile.camera->width + x;
        copy_run(alpha + at, opacity + k, pixels);
        copy_run(depth + at, distance + k, pixels);
        if (colours == 1) return copy_run(values + at, image->value[0] + k, pixels);
        for (int j = 0; j < pixels; ++j) {
            if (planes.channels) {
                values[at + j] = image->value[planes.channels[at + j]][k + j];
            } else {
                for (int c = 0; c < 3; ++c) values[3 * (at + j) + c] = image->value[c][k + j];
            }
        }
    });
}

// out[i] = the sum of v[i]'s lanes, for i < N; N is 8 or 4. The lanes are added as a tree, N sums at a time.
template <int N>
static inline void totals(const Vec* v, float* out) {
#if defined(__SSE2__) || defined(SPIKED_NEON)
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
template <int C, bool Moving>
struct Pixels {
    alignas(64) float t[kTilePixels], rest[kTilePixels], d[C][kTilePixels];
    alignas(64) float time[Moving ? kTilePixels : 1];
};

// Sums of one entry over its blocks. Capped: the splat is opaque enough to reach the cap, where alpha has no gradient.
// In two passes over the blocks, with less to wait for in each: a single chain from the offsets to the sums is longer
// than processors look ahead.
template <int C, bool Moving, bool Capped>
static inline void backward_entry(const float* s, uint32_t blocks, int index, const int32_t* ends,
                                  Pixels<C, Moving>& pixels, float* slot) {
    const Vec cut = broadcast(-kLog2Cut), cap = broadcast(kAlphaCap);
    alignas(64) float us[kTilePixels], ws[kTilePixels], alphas[kTilePixels];
    int32_t places[kBlocks * kParts];
    int count = 0;
    // u and w are linear: those of the first block's pixels, and what each block adds to them.
    alignas(64) float u_blocks[kBlocks], w_blocks[kBlocks];
    for (int block = 0; block < kBlocks; block += kLanes) {
        const Vec x = load(kBlockCorners.x + block), y = load(kBlockCorners.y + block);
        store(u_blocks + block, s[kP] * x + (s[kQ] * y + s[kS]));
        store(w_blocks + block, s[kR] * y + s[kT]);
    }
    Vec u_pixels[kParts], w_pixels[kParts];
    for (int part = 0; part < kParts; ++part) {
        const Vec x = load(kCentres.x + part * kLanes), y = load(kCentres.y + part * kLanes);
        u_pixels[part] = s[kP] * x + s[kQ] * y;
        w_pixels[part] = s[kR] * y;
    }
    for (; blocks; blocks &= blocks - 1) {
        const int block = __builtin_ctz(blocks);
        for (int part = 0; part < kParts; ++part) {
            if (kParts > 1 && index >= ends[block * kParts + part]) continue;
            const int at = block * 16 + part * kLanes;
            Vec u = u_pixels[part] + u_blocks[block], w = w_pixels[part] + w_blocks[block];
            if (Moving) {
                u -= s[kURate] * load(pixels.time + at);
                w -= s[kWRate] * load(pixels.time + at);
            }
            Vec log2_alpha = (s[kLog2Opacity] - u * u) - w * w;
            Vec alpha = select_ge(log2_alpha, cut, exp2_fast(log2_alpha));
            store(us + count * kLanes, u);
            store(ws + count * kLanes, w);
            store(alphas + count * kLanes, alpha);
            places[count++] = at;
        }
    }
    Vec sum[kColour0 + C] = {}, vut{}, vwt{};
    for (int i = 0; i < count; ++i) {
        const int at = places[i];
        const Vec u = load(us + i * kLanes), w = load(ws + i * kLanes), uncapped = load(alphas + i * kLanes);
        const Vec alpha = Capped ? min(uncapped, cap) : uncapped;
        Vec t = load(pixels.t + at), rest = load(pixels.rest + at);
        Vec share = alpha * t, by_colour[C], shown{};
        for (int k = 0; k < C; ++k) {
            by_colour[k] = share * load(pixels.d[k] + at);
            sum[kColour0 + k] += by_colour[k];
            shown += s[kC + k] * by_colour[k];
        }
        rest -= shown;
        store(pixels.t + at, t - share);
        store(pixels.rest + at, rest);
        Vec v = shown - rest * quotient(alpha, 1.0f - alpha);
        if (Capped) v = select_ge(cap, uncapped, v);
        Vec vu = v * u, vw = v * w;
        sum[kV] += v;
        sum[kVu] += vu;
        sum[kVw] += vw;
        sum[kVuu] += vu * u;
        sum[kVuw] += vu * w;
        sum[kVww] += vw * w;
        if (Moving) {
            vut += vu * load(pixels.time + at);
            vwt += vw * load(pixels.time + at);
        }
        sum[kShare] += share;
    }
    totals<8>(sum, slot);
    if (C == 3 || Moving) {
        // Colours 1 and 2 of three; without them these places are not read.
        Vec more[4] = {sum[kColour0 + C / 2], sum[kColour0 + C - 1], vut, vwt};
        totals<4>(more, slot + 8);
    }
}

template <int C, bool Moving>
static void backward_tile(const Tile& tile, const float* d_values, const Planes& planes, const TileState& state,
                          float* slots) {
    localise<C, Moving>(tile);
    Pixels<C, Moving> pixels = {};
    alignas(64) float weights[kTilePixels] = {};
    read_planes<Moving>(tile, planes, weights, pixels.time);
    each_run(tile, [&](int i, int x, int y, int run) {
        for (int j = 0; j < run; ++j) {
            const int64_t at = (int64_t)y * tile.camera->width + x + j;
            const float weight = weights[i + j];
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
    for (int i = 0; i < tile.count; ++i, s += local_floats(C, Moving)) {
        uint32_t blocks = tile.entries[i].blocks;
#if defined(__AVX512F__)
        blocks &= _mm512_cmpgt_epi32_mask(ends, _mm512_set1_epi32(i));
#endif
        float* slot = slots + (int64_t)i * slot_floats(C, Moving);
        if (s[kLog2Opacity] > kLog2Cap) {
            backward_entry<C, Moving, true>(s, blocks, i, state.ends, pixels, slot);
        } else {
            backward_entry<C, Moving, false>(s, blocks, i, state.ends, pixels, slot);
        }
    }
}

static void forward(const Tile& tile, int colours, const float background[3], const Planes& planes,
                    const TileState& state, TileImage* image) {
    auto* run = tile.motions ? (colours == 1 ? forward_tile<1, true> : forward_tile<3, true>)
                             : (colours == 1 ? forward_tile<1, false> : forward_tile<3, false>);
    run(tile, background, planes, state, image);
}

static void backward(const Tile& tile, int colours, const float* d_values, const Planes& planes, const TileState& state,
                     float* slots) {
    auto* run = tile.motions ? (colours == 1 ? backward_tile<1, true> : backward_tile<3, true>)
                             : (colours == 1 ? backward_tile<1, false> : backward_tile<3, false>);
    run(tile, d_values, planes, state, slots);
}

}  // namespace
}  // namespace spiked
