// The kernels, compiled once for each instruction set. Frames become one history byte a pixel and block of eight frames
// (bit f: fired in frame f); everything else is arithmetic on those bytes. No templates of the standard library here:
// the linker could keep the copy of an instruction set that the machine does not have.
#include "kernels.hpp"
#include "simd.inl"

namespace spiked {
namespace {

// One stored row of a run: which pointers to use and where the row begins.
struct Row {
    const uint8_t* const* frames;
    size_t at;
};

inline Row row_of(const Run& run, const Geometry& g, size_t stored) {
    if (stored >= g.tail_row) return {run.tails, (stored - g.tail_row) * g.row_stride};
    return {run.frames, stored * g.row_stride};
}

inline size_t upright_row(const Geometry& g, size_t stored) { return g.flipped ? g.height - 1 - stored : stored; }

void reduce(const ReduceJob& job) {
    const Geometry& g = job.geometry;
    const size_t width = g.width;
    for (size_t stored = 0; stored < g.height; ++stored) {
        const Row row = row_of(job.run, g, stored);
        const size_t out = upright_row(g, stored) * width;
        for (size_t column = 0; column * 8 < g.width; column += kWidth) {
            vec h[8];
            histories(row.frames, row.at + column, g.msb, h);
            for (size_t i = 0, x = column * 8; i < 8 && x < width; ++i, x += kWidth) {
                store(job.count + out + x, popcount(h[i]), width - x);
                store(job.first + out + x, lowest(h[i]), width - x);
                store(job.last + out + x, highest(h[i]), width - x);
            }
        }
    }
}

// Distances of up to this many blocks fit in a byte beside kNever8.
constexpr int kSpan = 31;

inline int span_blocks(const Run& run, int from) { return run.blocks - from < kSpan ? run.blocks - from : kSpan; }

// From block numbers and history bytes to distances in frames, kNever8 where the byte is empty.
inline vec distance(vec block, vec h) { return ((block << 3) + lowest(h)) | is_zero(h); }

inline uint16_t widened(uint8_t distance, int from) {
    return distance == kNever8 ? kNever16 : static_cast<uint16_t>(distance + 8 * from);
}

// Distances to the nearest and the second nearest spike along a run, for 8 * kWidth pixels.
void nearest_two(const Run& run, Row row, bool msb, uint16_t* nearest, uint16_t* second) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        // The first and second non-empty history byte of each pixel, and how many blocks were waited for them.
        vec h1[8] = {}, h2[8] = {}, wait1[8] = {}, wait2[8] = {};
        for (int k = 0; k < blocks; ++k) {
            vec h[8];
            histories(row.frames + 8 * (from + k), row.at, msb, h);
            for (int i = 0; i < 8; ++i) {
                const vec pending1 = is_zero(h1[i]);
                const vec pending2 = is_zero(h2[i]) & ~pending1;
                h1[i] |= h[i] & pending1;
                h2[i] |= h[i] & pending2;
                wait1[i] -= pending1;
                wait2[i] -= pending2;
            }
        }
        alignas(64) uint8_t near[8 * kWidth], next[8 * kWidth];
        for (int i = 0; i < 8; ++i) {
            const vec block1 = wait1[i] - 1;
            const vec rest = h1[i] & (h1[i] - 1);
            const vec d1 = distance(block1, h1[i]);
            const vec d2 = smaller(distance(block1, rest), distance(block1 + wait2[i], h2[i]));
            store(near + i * kWidth, d1, kWidth);
            store(next + i * kWidth, d2, kWidth);
        }
        if (from == 0) {
            for (int x = 0; x < 8 * kWidth; ++x) nearest[x] = widened(near[x], 0);
            for (int x = 0; x < 8 * kWidth; ++x) second[x] = widened(next[x], 0);
        } else {
            for (int x = 0; x < 8 * kWidth; ++x) {
                const uint16_t d1 = widened(near[x], from), d2 = widened(next[x], from);
                const uint16_t behind = nearest[x] == kNever16 ? d2 : d1;
                second[x] = second[x] == kNever16 ? behind : second[x];
                nearest[x] = nearest[x] == kNever16 ? d1 : nearest[x];
            }
        }
        from += kSpan;
    } while (from < run.blocks);
}

// First spike, last spike and number of spikes along a run, for 8 * kWidth pixels.
void inside_window(const Run& run, Row row, bool msb, uint16_t* first, uint16_t* last, uint16_t* count) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        vec h1[8] = {}, hl[8] = {}, wait[8] = {}, block[8] = {}, sum[8] = {};
        for (int k = 0; k < blocks; ++k) {
            vec h[8];
            histories(row.frames + 8 * (from + k), row.at, msb, h);
            const vec number = splat(static_cast<uint8_t>(k));
            for (int i = 0; i < 8; ++i) {
                const vec pending = is_zero(h1[i]);
                const vec empty = is_zero(h[i]);
                h1[i] |= h[i] & pending;
                wait[i] -= pending;
                hl[i] = h[i] | (hl[i] & empty);
                block[i] = (number & ~empty) | (block[i] & empty);
                sum[i] += popcount(h[i]);
            }
        }
        alignas(64) uint8_t begin[8 * kWidth], end[8 * kWidth], total[8 * kWidth];
        for (int i = 0; i < 8; ++i) {
            store(begin + i * kWidth, distance(wait[i] - 1, h1[i]), kWidth);
            store(end + i * kWidth, ((block[i] << 3) + highest(hl[i])) | is_zero(hl[i]), kWidth);
            store(total + i * kWidth, sum[i], kWidth);
        }
        if (from == 0) {
            for (int x = 0; x < 8 * kWidth; ++x) first[x] = widened(begin[x], 0);
            for (int x = 0; x < 8 * kWidth; ++x) last[x] = widened(end[x], 0);
            for (int x = 0; x < 8 * kWidth; ++x) count[x] = total[x];
        } else {
            for (int x = 0; x < 8 * kWidth; ++x) {
                first[x] = first[x] == kNever16 ? widened(begin[x], from) : first[x];
                last[x] = end[x] == kNever8 ? last[x] : widened(end[x], from);
                count[x] = static_cast<uint16_t>(count[x] + total[x]);
            }
        }
        from += kSpan;
    } while (from < run.blocks);
}

struct RowState {
    const uint16_t *p1, *p2;             // last and last but one spike before begin, as frames before begin - 1
    const uint16_t *first, *last, *sum;  // spikes inside, as frames after begin
    const uint16_t *n1, *n2;             // first and second spike at or after end, as frames after end
};

// The spikes nearest to both edges; see spiked.blocks.Window for the rules.
void choose_edges(const RowState& s, const WindowJob& job, size_t width, size_t out) {
    uint16_t* __restrict spikes = job.spikes + out;
    uint16_t* __restrict start = job.start + out;
    uint16_t* __restrict stop = job.stop + out;
    uint16_t* __restrict count = job.count + out;
    const uint16_t begin = job.begin, end = job.end, length = end - begin;
    for (size_t x = 0; x < width; ++x) {
        const uint16_t p1 = s.p1[x], n1 = s.n1[x], inside = s.sum[x];
        // Distances from begin to the spike at or after it, and from end to the spike before it.
        const uint16_t far_n = n1 == kNever16 ? kNever16 : static_cast<uint16_t>(n1 + length);
        const uint16_t far_p = p1 == kNever16 ? kNever16 : static_cast<uint16_t>(p1 + length);
        const uint16_t last_back = static_cast<uint16_t>(length - 1 - s.last[x]);
        const uint16_t next_b = inside ? s.first[x] : far_n;
        const uint16_t prev_e = inside ? last_back : far_p;
        // A spike just as far on either side: the outer one, for the longer window.
        const bool outer0 = p1 <= next_b, outer1 = n1 <= prev_e;
        const bool any = inside || p1 != kNever16 || n1 != kNever16;
        const uint16_t m = any ? static_cast<uint16_t>(inside + outer1 - !outer0) : 0;
        const uint16_t t0 = outer0 ? static_cast<uint16_t>(begin - 1 - p1) : static_cast<uint16_t>(begin + next_b);
        const uint16_t t1 = outer1 ? static_cast<uint16_t>(end + n1) : static_cast<uint16_t>(end - 1 - prev_e);
        // Both edges on one spike: each moves outwards to its neighbour.
        const uint16_t back = outer0 ? s.p2[x] : p1, ahead = outer1 ? s.n2[x] : n1;
        const bool one = any && m == 0;
        const bool extend0 = one && back != kNever16, extend1 = one && ahead != kNever16;
        spikes[x] = static_cast<uint16_t>(m + extend0 + extend1);
        start[x] = !any ? kNever16 : extend0 ? static_cast<uint16_t>(begin - 1 - back) : t0;
        stop[x] = !any ? kNever16 : extend1 ? static_cast<uint16_t>(end + ahead) : t1;
        count[x] = inside;
    }
}

void window(const WindowJob& job) {
    const Geometry& g = job.geometry;
    const size_t padded = g.padded_row * 8;
    uint16_t* rows[kWindowRows];
    for (int i = 0; i < kWindowRows; ++i) rows[i] = job.scratch + i * padded;
    for (size_t stored = 0; stored < g.height; ++stored) {
        Row before = row_of(job.before, g, stored);
        Row inside = row_of(job.inside, g, stored);
        Row after = row_of(job.after, g, stored);
        for (size_t column = 0; column * 8 < g.width; column += kWidth) {
            const size_t x = column * 8;
            nearest_two(job.before, before, g.msb, rows[0] + x, rows[1] + x);
            inside_window(job.inside, inside, g.msb, rows[2] + x, rows[3] + x, rows[4] + x);
            nearest_two(job.after, after, g.msb, rows[5] + x, rows[6] + x);
            before.at += kWidth;
            inside.at += kWidth;
            after.at += kWidth;
        }
        const RowState state = {rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]};
        choose_edges(state, job, g.width, upright_row(g, stored) * g.width);
    }
}

}  // namespace
}  // namespace spiked
