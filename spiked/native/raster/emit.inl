// Which 4x4 blocks of which tiles a splat reaches, exactly up to a hundredth of a pixel: for each row of blocks, the
// extent of the ellipse alpha >= 1/255 within the band of its pixel centres.

constexpr float kMargin = 0.01f;  // px; absorbs rounding, costs next to nothing

alignas(64) static constexpr float kFours[16] = {0, 4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60};

// Fills first[] and last[] (columns of blocks, empty when first > last) for `rows` rows of blocks from `row`.
static void block_columns(const Record& s, const Lens& lens, int row, int rows, int32_t* first, int32_t* last) {
    const float reach = s.log2_opacity + kLog2Cut;
    const float half_y = s.half_y + kMargin;
    const Vec lane = load(kFours);
    for (int at = 0; at < rows; at += kLanes) {
        Vec low = lane + (4.0f * (row + at) + 0.5f - s.y), high = low + 3.0f;
        low = max(low, splat(-half_y));
        high = min(high, splat(half_y));
        Vec right_dy = clamp(splat(s.extreme), low, high), left_dy = clamp(splat(-s.extreme), low, high);
        Vec right = root(max(reach - s.r * s.r * right_dy * right_dy, Vec{})) - s.q * right_dy;
        Vec left = -root(max(reach - s.r * s.r * left_dy * left_dy, Vec{})) - s.q * left_dy;
        Vec width = splat(lens.width);
        Vec last_pixel = clamp(s.x + right * s.over_p - (0.5f - kMargin), splat(-1.0f), width - 1.0f) + 1.0f;
        Vec first_pixel = width - clamp(s.x + left * s.over_p - (0.5f + kMargin), Vec{}, width);
        Int b = (__builtin_convertvector(last_pixel, Int) - 1) >> 2;
        Int a = (lens.width - __builtin_convertvector(first_pixel, Int)) >> 2;
        Int active = low <= high;
        a = active ? a : Int{} + kMaxSide;
        b = active ? b : Int{} - 1;
        __builtin_memcpy(first + at, &a, sizeof a);
        __builtin_memcpy(last + at, &b, sizeof b);
    }
}

// A bit for each column of blocks from first to last of the 16 that start at `from`.
static inline uint64_t columns_of(int first, int last, int from) {
    first = first > from ? first - from : 0;
    last = last - from < 15 ? last - from : 15;
    return first > last ? 0 : 0xffffu << first & 0xffffu >> (15 - last);
}

// From four rows of sixteen blocks to four tiles of 4x4 blocks: transposes a 4x4 matrix of nibbles.
static inline uint64_t tiles_of(uint64_t rows) {
    uint64_t swap = (rows ^ rows >> 12) & 0x0000f0f00000f0f0u;
    rows ^= swap ^ swap << 12;
    swap = (rows ^ rows >> 24) & 0x00000000ff00ff00u;
    return rows ^ swap ^ swap << 24;
}

struct TileRows {
    int first, last;  // empty when first > last
};

static inline TileRows tile_rows(const Record& s, const Lens& lens) {
    const float top = s.y - s.half_y - (0.5f + kMargin), bottom = s.y + s.half_y - (0.5f - kMargin);
    if (bottom < 0 || top > lens.height - 1) return {0, -1};
    return {top <= 0 ? 0 : (int)top / kTile, (bottom >= lens.height - 1 ? lens.height - 1 : (int)bottom) / kTile};
}

// From the columns of blocks that one splat reaches to its pairs.
static inline int emit_tiles(TileRows span, const int32_t* first, const int32_t* last, uint32_t rank, const Lens& lens,
                             Pair* out) {
    Pair* end = out;
    for (int tile_y = span.first; tile_y <= span.last; ++tile_y, first += 4, last += 4) {
        int from = kMaxSide, to = -1;
        for (int k = 0; k < 4; ++k) {
            from = first[k] < from ? first[k] : from;
            to = last[k] > to ? last[k] : to;
        }
        for (from &= ~3; from <= to; from += 16) {
            uint64_t rows = 0;
            for (int k = 0; k < 4; ++k) rows |= columns_of(first[k], last[k], from) << (16 * k);
            uint64_t tiles = tiles_of(rows);
            const uint32_t tile = (uint32_t)(tile_y * lens.tiles_x + from / 4);
            // Written whether reached or not, which is cheaper than to ask; `out` has room for three more.
            for (uint32_t k = 0; k < 4; ++k, tiles >>= 16) {
                *end = {(tile + k) << 16 | (uint32_t)(tiles & 0xffff), rank};
                end += (tiles & 0xffff) != 0;
            }
        }
    }
    return (int)(end - out);
}

static int emit(const Record* records, int first, int last, const Lens& lens, int32_t* columns, const Pairs& out) {
    const int stride = lens.tiles_y * 4 + kGroup;
    const uint32_t most = kEmitBatch * ((uint32_t)(lens.tiles_x * lens.tiles_y) + 4);
    uint32_t size = *out.size;
    int rank = first;
    while (rank < last && size + most <= out.room) {
        const int count = last - rank < kEmitBatch ? last - rank : kEmitBatch;
        // In two passes, since the second one's branches are hard to foretell: they must not wait for the arithmetic.
        TileRows rows[kEmitBatch];
        for (int i = 0; i < count; ++i) {
            rows[i] = tile_rows(records[rank + i], lens);
            block_columns(records[rank + i], lens, 4 * rows[i].first, 4 * (rows[i].last - rows[i].first + 1),
                          columns + 2 * i * stride, columns + (2 * i + 1) * stride);
        }
        for (int i = 0; i < count; ++i, ++rank) {
            Pair* pairs = out.pairs + size;
            const int emitted = emit_tiles(rows[i], columns + 2 * i * stride, columns + (2 * i + 1) * stride,
                                           (uint32_t)rank, lens, pairs);
            for (int k = 0; k < emitted; ++k) ++out.tile_counts[pairs[k].tile_blocks >> 16];
            out.counts[records[rank].splat] = (uint32_t)emitted;
            size += (uint32_t)emitted;
        }
    }
    *out.size = size;
    return rank;
}
