// Which 4x4 blocks of which tiles a splat reaches, exactly up to a hundredth of a pixel: for each row of blocks, the
// extent of the ellipse alpha >= 1/255 within the band of its pixel centres.

namespace spiked {
namespace {

alignas(64) static constexpr float kFours[16] = {0, 4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60};

// Columns of blocks that a splat reaches in each row of blocks, empty where first > last.
struct Columns {
    int32_t *first, *last;
    uint16_t* bits;  // the same as bits of the 16 columns that begin at `from`; only while narrow
    int from;
    bool narrow;  // no row goes beyond those
};

// Fills the columns of `rows` rows of blocks from `row`.
static void block_columns(const ProjectedSplat& s, const PinholeF& camera, int row, int rows, Columns& out) {
    const float half_y = s.half_y + kMargin;
    // As far as the ellipse reaches anywhere, which no row goes beyond.
    const float left_most = s.x - s.half_x - (0.5f + 4 * kMargin), right_most = s.x + s.half_x - (0.5f - 4 * kMargin);
    out.from = left_most <= 0 ? 0 : (int)(left_most < camera.width ? left_most : camera.width) / kTile * 4;
    out.narrow = (right_most < camera.width - 1 ? right_most : camera.width - 1) < (float)(4 * (out.from + 16));
    const Vec lane = load(kFours);
    for (int at = 0; at < rows; at += kLanes) {
        Vec low = lane + (4.0f * (row + at) + 0.5f - s.y), high = low + 3.0f;
        low = max(low, broadcast(-half_y));
        high = min(high, broadcast(half_y));
        Vec left, right;
        extent_in_rows(s, low, high, left, right);
        Vec width = broadcast(camera.width);
        Vec last_pixel = clamp(s.x + right * s.over_p - (0.5f - kMargin), broadcast(-1.0f), width - 1.0f) + 1.0f;
        Vec first_pixel = width - clamp(s.x + left * s.over_p - (0.5f + kMargin), Vec{}, width);
        Int b = (__builtin_convertvector(last_pixel, Int) - 1) >> 2;
        Int a = (camera.width - __builtin_convertvector(first_pixel, Int)) >> 2;
        Int active = low <= high;
        if (out.narrow) {
            active &= a <= b;
            const Int from = active ? a - out.from : Int{} + 16;
            const Int to = active ? b - out.from : Int{} + 15;
            const Int bits = ((Int{} + 2) << to) - ((Int{} + 1) << from);
            typedef uint16_t Bits __attribute__((vector_size(kLanes * 2)));
            const Bits narrow = __builtin_convertvector(bits, Bits);
            __builtin_memcpy(out.bits + at, &narrow, sizeof narrow);
            continue;
        }
        a = active ? a : Int{} + kMaxSide;
        b = active ? b : Int{} - 1;
        __builtin_memcpy(out.first + at, &a, sizeof a);
        __builtin_memcpy(out.last + at, &b, sizeof b);
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

static inline TileRows tile_rows(const ProjectedSplat& s, const PinholeF& camera) {
    const float top = s.y - s.half_y - (0.5f + kMargin), bottom = s.y + s.half_y - (0.5f - kMargin);
    if (bottom < 0 || top > camera.height - 1) return {0, -1};
    return {top <= 0 ? 0 : (int)top / kTile, (bottom >= camera.height - 1 ? camera.height - 1 : (int)bottom) / kTile};
}

// Writes the pairs of four tiles from `tile` on that four rows of sixteen blocks reach.
static inline TilePair* intersect_four_tiles(uint64_t rows, uint32_t tile, uint32_t rank, TilePair* end) {
    uint64_t tiles = tiles_of(rows);
    // Written whether reached or not, which is cheaper than a branch; `out` has room for three more.
    for (uint32_t k = 0; k < 4; ++k, tiles >>= 16) {
        *end = {(tile + k) << 16 | (uint32_t)(tiles & 0xffff), rank};
        end += (tiles & 0xffff) != 0;
    }
    return end;
}

// From the columns of blocks that one splat reaches to its pairs.
static inline int tile_pairs_of(TileRows span, const Columns& columns, uint32_t rank, const PinholeF& camera,
                                TilePair* out) {
    TilePair* end = out;
    if (columns.narrow) {
        const uint16_t* bits = columns.bits;
        for (int tile_y = span.first; tile_y <= span.last; ++tile_y, bits += 4) {
            uint64_t rows;
            __builtin_memcpy(&rows, bits, sizeof rows);
            end = intersect_four_tiles(rows, (uint32_t)(tile_y * camera.tiles_x + columns.from / 4), rank, end);
        }
        return (int)(end - out);
    }
    const int32_t *first = columns.first, *last = columns.last;
    for (int tile_y = span.first; tile_y <= span.last; ++tile_y, first += 4, last += 4) {
        int from = kMaxSide, to = -1;
        for (int k = 0; k < 4; ++k) {
            from = first[k] < from ? first[k] : from;
            to = last[k] > to ? last[k] : to;
        }
        for (from &= ~3; from <= to; from += 16) {
            uint64_t rows = 0;
            for (int k = 0; k < 4; ++k) rows |= columns_of(first[k], last[k], from) << (16 * k);
            end = intersect_four_tiles(rows, (uint32_t)(tile_y * camera.tiles_x + from / 4), rank, end);
        }
    }
    return (int)(end - out);
}

static int intersect_tiles(const ProjectedSplat* records, int first, int last, const PinholeF& camera, int32_t* columns,
                           const TilePairList& out) {
    const int stride = camera.tiles_y * 4 + kGroup;
    const uint32_t most = kSplatBatch * ((uint32_t)(camera.tiles_x * camera.tiles_y) + 4);
    uint32_t size = *out.size;
    int rank = first;
    while (rank < last && size + most <= out.room) {
        const int count = last - rank < kSplatBatch ? last - rank : kSplatBatch;
        // In two passes: the second one's branches are hard to predict and must not wait for the arithmetic.
        TileRows rows[kSplatBatch];
        Columns reached[kSplatBatch];
        for (int i = 0; i < count; ++i) {
            rows[i] = tile_rows(records[rank + i], camera);
            int32_t* own = columns + 2 * i * stride;
            reached[i].first = own;
            reached[i].last = own + stride;
            reached[i].bits = (uint16_t*)own;
            block_columns(records[rank + i], camera, 4 * rows[i].first, 4 * (rows[i].last - rows[i].first + 1),
                          reached[i]);
        }
        for (int i = 0; i < count; ++i, ++rank) {
            TilePair* pairs = out.pairs + size;
            const int written = tile_pairs_of(rows[i], reached[i], (uint32_t)rank, camera, pairs);
            for (int k = 0; k < written; ++k) ++out.tile_counts[pairs[k].tile_blocks >> 16];
            out.counts[records[rank].splat] = (uint32_t)written;
            size += (uint32_t)written;
        }
    }
    *out.size = size;
    return rank;
}

}  // namespace
}  // namespace spiked
