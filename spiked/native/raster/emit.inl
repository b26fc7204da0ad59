// Which 4x4 blocks of which tiles a splat reaches, exactly up to a hundredth of a pixel: for each row of blocks, the
// extent of the ellipse alpha >= 1/255 within the band of its pixel centres.

constexpr float kMargin = 0.01f;  // px; absorbs rounding, costs next to nothing

// Fills first[] and last[] (columns of blocks, empty when first > last) for `rows` rows of blocks from `row`.
static void block_columns(const Record& s, const Lens& lens, int row, int rows, int32_t* first, int32_t* last) {
    const float reach = s.log2_opacity + kLog2Cut;
    const float root_reach = __builtin_sqrtf(reach < 0 ? 0 : reach);
    const float half_y = root_reach / s.r + kMargin;
    // The offset dy of the ellipse's rightmost point; the leftmost is at -dy.
    const float extreme = -s.q * root_reach / (s.r * __builtin_sqrtf(s.q * s.q + s.r * s.r));
    const float over_p = 1.0f / s.p;
    Vec lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = 4.0f * i;
    for (int at = 0; at < rows; at += kLanes) {
        Vec low = lane + (4.0f * (row + at) + 0.5f - s.y), high = low + 3.0f;
        low = max(low, splat(-half_y));
        high = min(high, splat(half_y));
        Vec right_dy = clamp(splat(extreme), low, high), left_dy = clamp(splat(-extreme), low, high);
        Vec right = root(max(reach - s.r * s.r * right_dy * right_dy, Vec{})) - s.q * right_dy;
        Vec left = -root(max(reach - s.r * s.r * left_dy * left_dy, Vec{})) - s.q * left_dy;
        Vec width = splat(lens.width);
        Vec last_pixel = clamp(s.x + right * over_p - (0.5f - kMargin), splat(-1.0f), width - 1.0f) + 1.0f;
        Vec first_pixel = width - clamp(s.x + left * over_p - (0.5f + kMargin), Vec{}, width);
        Int b = (__builtin_convertvector(last_pixel, Int) - 1) >> 2;
        Int a = (lens.width - __builtin_convertvector(first_pixel, Int)) >> 2;
        Int active = low <= high;
        a = active ? a : Int{} + kMaxSide;
        b = active ? b : Int{} - 1;
        __builtin_memcpy(first + at, &a, sizeof a);
        __builtin_memcpy(last + at, &b, sizeof b);
    }
}

static inline uint32_t four_blocks(int first, int last) {
    if (first < 0) first = 0;
    if (last > 3) last = 3;
    return first > last ? 0u : (0xfu << first) & (0xfu >> (3 - last));
}

static int emit(const Record& s, uint32_t rank, const Lens& lens, int32_t* columns, Pair* out) {
    const float reach = s.log2_opacity + kLog2Cut;
    const float half_y = __builtin_sqrtf(reach < 0 ? 0 : reach) / s.r + kMargin;
    const float top = s.y - half_y - 0.5f, bottom = s.y + half_y - 0.5f;
    if (bottom < 0 || top > lens.height - 1) return 0;
    const int first_row = top <= 0 ? 0 : (int)top / kTile;
    const int last_row = (bottom >= lens.height - 1 ? lens.height - 1 : (int)bottom) / kTile;
    const int rows = 4 * (last_row - first_row + 1);
    int32_t* first = columns;
    int32_t* last = columns + (rows + kLanes - 1) / kLanes * kLanes;
    block_columns(s, lens, 4 * first_row, rows, first, last);

    Pair* end = out;
    for (int tile_y = first_row; tile_y <= last_row; ++tile_y, first += 4, last += 4) {
        int from = kMaxSide, to = -1;
        for (int k = 0; k < 4; ++k) {
            if (first[k] > last[k]) continue;
            if (first[k] < from) from = first[k];
            if (last[k] > to) to = last[k];
        }
        for (int tile_x = from >> 2; tile_x <= to >> 2; ++tile_x) {
            uint32_t blocks = 0;
            for (int k = 0; k < 4; ++k) blocks |= four_blocks(first[k] - 4 * tile_x, last[k] - 4 * tile_x) << (4 * k);
            if (blocks) *end++ = {(uint32_t)(tile_y * lens.tiles_x + tile_x) << 16 | blocks, rank};
        }
    }
    return (int)(end - out);
}
