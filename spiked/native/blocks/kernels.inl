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

constexpr int kHalf = kWidth / 2;  // pixels in a `wide`

// Offsets from the beginning of a span to offsets from the beginning of its run.
inline wide from_run(const uint8_t* in_span, int from) {
    const wide v = load_widened(in_span);
    return (v + static_cast<uint16_t>(8 * from)) | (wide)(v == kNever8);
}

inline void store_all(uint16_t* to, wide v) { store_wide(to, v, kWidth); }

// Distances to the nearest and the second nearest spike along a run, for 8 * kWidth pixels.
void nearest_two(const Run& run, Row row, bool msb, uint16_t* nearest, uint16_t* second) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        // The first and second non-empty history byte of each pixel, and how many blocks were waited for them.
        vec h1[8], h2[8], wait1[8], wait2[8];
        for (int i = 0; i < 8; ++i) h1[i] = h2[i] = wait1[i] = wait2[i] = vec{};
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
        for (int x = 0; x < 8 * kWidth; x += kHalf) {
            wide d1 = from_run(near + x, from), d2 = from_run(next + x, from);
            if (from > 0) {
                const wide before1 = load_wide(nearest + x), before2 = load_wide(second + x);
                const wide empty1 = (wide)(before1 == kNever16), empty2 = (wide)(before2 == kNever16);
                d2 = choose(empty2, choose(empty1, d2, d1), before2);
                d1 = choose(empty1, d1, before1);
            }
            store_all(nearest + x, d1);
            store_all(second + x, d2);
        }
        from += kSpan;
    } while (from < run.blocks);
}

// First spike, last spike and number of spikes along a run, for 8 * kWidth pixels.
void inside_window(const Run& run, Row row, bool msb, uint16_t* first, uint16_t* last, uint16_t* count) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        vec h1[8], hl[8], wait[8], block[8], sum[8];
        for (int i = 0; i < 8; ++i) h1[i] = hl[i] = wait[i] = block[i] = sum[i] = vec{};
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
        for (int x = 0; x < 8 * kWidth; x += kHalf) {
            wide f = from_run(begin + x, from), l = from_run(end + x, from), c = load_widened(total + x);
            if (from > 0) {
                const wide before = load_wide(first + x);
                f = choose((wide)(before == kNever16), f, before);
                l = choose((wide)(l == kNever16), load_wide(last + x), l);
                c += load_wide(count + x);
            }
            store_all(first + x, f);
            store_all(last + x, l);
            store_all(count + x, c);
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
    const wide never = wide{} + kNever16;
    const wide begin = wide{} + job.begin, end = wide{} + job.end, length = end - begin;
    for (size_t x = 0; x < width; x += kHalf) {
        const wide p1 = load_wide(s.p1 + x), n1 = load_wide(s.n1 + x), inside = load_wide(s.sum + x);
        const wide fired = (wide)(inside != 0);
        // Distances from begin to the spike at or after it, and from end to the spike before it.
        const wide next_b = choose(fired, load_wide(s.first + x), (n1 + length) | (wide)(n1 == never));
        const wide prev_e = choose(fired, length - 1 - load_wide(s.last + x), (p1 + length) | (wide)(p1 == never));
        // A spike just as far on either side: the outer one, for the longer window.
        const wide outer0 = (wide)(p1 <= next_b), outer1 = (wide)(n1 <= prev_e);
        const wide none = (wide)((p1 & next_b) == never);
        const wide m = (inside - outer1 + ~outer0) & ~none;
        // Both edges on one spike: each moves outwards to its neighbour.
        const wide back = choose(outer0, load_wide(s.p2 + x), p1), ahead = choose(outer1, load_wide(s.n2 + x), n1);
        const wide one = (wide)(m == 0) & ~none;
        const wide extend0 = one & (wide)(back != never), extend1 = one & (wide)(ahead != never);
        const wide t0 = choose(outer0, begin - 1 - p1, begin + next_b);
        const wide t1 = choose(outer1, end + n1, end - 1 - prev_e);
        const size_t room = 2 * (width - x);
        store_wide(job.spikes + out + x, m - extend0 - extend1, room);
        store_wide(job.start + out + x, choose(extend0, begin - 1 - back, t0) | none, room);
        store_wide(job.stop + out + x, choose(extend1, end + ahead, t1) | none, room);
        store_wide(job.count + out + x, inside, room);
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

// The eight pixels of every byte, LSB first and MSB first.
struct Unpacked {
    uint8_t pixels[2][256][8];
    constexpr Unpacked() : pixels() {
        for (int byte = 0; byte < 256; ++byte)
            for (int k = 0; k < 8; ++k) {
                pixels[0][byte][k] = (uint8_t)(byte >> k & 1);
                pixels[1][byte][k] = (uint8_t)(byte >> (7 - k) & 1);
            }
    }
};
constexpr Unpacked kUnpacked;

void unpack(const uint8_t* row, size_t bytes, bool msb, uint8_t* pixels) {
    size_t i = 0;
#if defined(__AVX512BITALG__) && defined(__GFNI__)
    for (; !msb && i + 8 <= bytes; i += 8) {
        uint64_t bits;
        memcpy(&bits, row + i, sizeof bits);
        _mm512_storeu_si512(pixels + 8 * i, _mm512_maskz_set1_epi8(bits, 1));
    }
#endif
    for (; i < bytes; ++i) memcpy(pixels + 8 * i, kUnpacked.pixels[msb][row[i]], 8);
}

}  // namespace
}  // namespace spiked
