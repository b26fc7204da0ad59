// Frames become one history byte for each pixel and block of eight frames (bit f: fired in frame f); everything else is
// arithmetic on those bytes. No templates of the standard library here, see instruction_sets.hpp.
#include "kernels.hpp"

#include "../common/simd.hpp"

namespace spiked {
namespace {

// One stored row of a run: which pointers to use and where the row begins.
struct Row {
    const uint8_t* const* frames;
    size_t at;
};

inline Row row_of(const Run& run, const FrameLayout& g, size_t stored) {
    if (stored >= g.tail_row) return {run.tails, (stored - g.tail_row) * g.row_stride};
    return {run.frames, stored * g.row_stride};
}

inline size_t upright_row(const FrameLayout& g, size_t stored) { return g.flipped ? g.height - 1 - stored : stored; }

// Distances of up to this many blocks fit in a byte beside kNever8.
constexpr int kSpan = 31;

inline int span_blocks(const Run& run, int from) { return run.blocks - from < kSpan ? run.blocks - from : kSpan; }

// From block numbers and history bytes to distances in frames, kNever8 where the byte is empty.
inline Bytes distance(Bytes block, Bytes h) { return ((block << 3) + lowest(h)) | is_zero(h); }

constexpr int kHalf = kBytes / 2;  // pixels in a vector of words

// Offsets from the beginning of a span to offsets from the beginning of its run.
inline Words from_run(const uint8_t* in_span, int from) {
    const Words v = load_widened(in_span);
    return (v + static_cast<uint16_t>(8 * from)) | (Words)(v == kNever8);
}

inline void store_all(uint16_t* to, Words v) { store_words(to, v, kBytes); }

// Distances to the nearest and the second nearest spike along a run, for 8 * kBytes pixels.
void nearest_two(const Run& run, Row row, bool msb, uint16_t* nearest, uint16_t* second) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        // The first and second non-empty history byte of each pixel, and the number of blocks before them.
        Bytes h1[8], h2[8], wait1[8], wait2[8];
        for (int i = 0; i < 8; ++i) h1[i] = h2[i] = wait1[i] = wait2[i] = Bytes{};
        for (int k = 0; k < blocks; ++k) {
            Bytes h[8];
            histories(row.frames + 8 * (from + k), row.at, msb, h);
            for (int i = 0; i < 8; ++i) {
                const Bytes pending1 = is_zero(h1[i]);
                const Bytes pending2 = is_zero(h2[i]) & ~pending1;
                h1[i] |= h[i] & pending1;
                h2[i] |= h[i] & pending2;
                wait1[i] -= pending1;
                wait2[i] -= pending2;
            }
        }
        alignas(64) uint8_t near[8 * kBytes], next[8 * kBytes];
        for (int i = 0; i < 8; ++i) {
            const Bytes block1 = wait1[i] - 1;
            const Bytes rest = h1[i] & (h1[i] - 1);
            const Bytes d1 = distance(block1, h1[i]);
            const Bytes d2 = smaller(distance(block1, rest), distance(block1 + wait2[i], h2[i]));
            store(near + i * kBytes, d1, kBytes);
            store(next + i * kBytes, d2, kBytes);
        }
        for (int x = 0; x < 8 * kBytes; x += kHalf) {
            Words d1 = from_run(near + x, from), d2 = from_run(next + x, from);
            if (from > 0) {
                const Words before1 = load_words(nearest + x), before2 = load_words(second + x);
                const Words empty1 = (Words)(before1 == kNever16), empty2 = (Words)(before2 == kNever16);
                d2 = select(empty2, select(empty1, d2, d1), before2);
                d1 = select(empty1, d1, before1);
            }
            store_all(nearest + x, d1);
            store_all(second + x, d2);
        }
        from += kSpan;
    } while (from < run.blocks);
}

// First spike, last spike and number of spikes along a run, for 8 * kBytes pixels.
void inside_window(const Run& run, Row row, bool msb, uint16_t* first, uint16_t* last, uint16_t* count) {
    int from = 0;
    do {
        const int blocks = span_blocks(run, from);
        Bytes h1[8], hl[8], wait[8], block[8], sum[8];
        for (int i = 0; i < 8; ++i) h1[i] = hl[i] = wait[i] = block[i] = sum[i] = Bytes{};
        for (int k = 0; k < blocks; ++k) {
            Bytes h[8];
            histories(row.frames + 8 * (from + k), row.at, msb, h);
            const Bytes number = broadcast_byte(static_cast<uint8_t>(k));
            for (int i = 0; i < 8; ++i) {
                const Bytes pending = is_zero(h1[i]);
                const Bytes empty = is_zero(h[i]);
                h1[i] |= h[i] & pending;
                wait[i] -= pending;
                hl[i] = h[i] | (hl[i] & empty);
                block[i] = (number & ~empty) | (block[i] & empty);
                sum[i] += popcount(h[i]);
            }
        }
        alignas(64) uint8_t begin[8 * kBytes], end[8 * kBytes], total[8 * kBytes];
        for (int i = 0; i < 8; ++i) {
            store(begin + i * kBytes, distance(wait[i] - 1, h1[i]), kBytes);
            store(end + i * kBytes, ((block[i] << 3) + highest(hl[i])) | is_zero(hl[i]), kBytes);
            store(total + i * kBytes, sum[i], kBytes);
        }
        for (int x = 0; x < 8 * kBytes; x += kHalf) {
            Words f = from_run(begin + x, from), l = from_run(end + x, from), c = load_widened(total + x);
            if (from > 0) {
                const Words before = load_words(first + x);
                f = select((Words)(before == kNever16), f, before);
                l = select((Words)(l == kNever16), load_words(last + x), l);
                c += load_words(count + x);
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
void select_edges(const RowState& s, const WindowJob& job, size_t width, size_t out) {
    const Words never = Words{} + kNever16;
    const Words begin = Words{} + job.begin, end = Words{} + job.end, length = end - begin;
    for (size_t x = 0; x < width; x += kHalf) {
        const Words p1 = load_words(s.p1 + x), n1 = load_words(s.n1 + x), inside = load_words(s.sum + x);
        const Words fired = (Words)(inside != 0);
        // Distances from begin to the spike at or after it, and from end to the spike before it.
        const Words next_b = select(fired, load_words(s.first + x), (n1 + length) | (Words)(n1 == never));
        const Words prev_e = select(fired, length - 1 - load_words(s.last + x), (p1 + length) | (Words)(p1 == never));
        // A spike just as far on either side: the outer one, for the longer window.
        const Words outer0 = (Words)(p1 <= next_b), outer1 = (Words)(n1 <= prev_e);
        const Words none = (Words)((p1 & next_b) == never);
        const Words m = (inside - outer1 + ~outer0) & ~none;
        // Both edges on one spike: each moves outwards to its neighbour.
        const Words back = select(outer0, load_words(s.p2 + x), p1), ahead = select(outer1, load_words(s.n2 + x), n1);
        const Words one = (Words)(m == 0) & ~none;
        const Words extend0 = one & (Words)(back != never), extend1 = one & (Words)(ahead != never);
        const Words t0 = select(outer0, begin - 1 - p1, begin + next_b);
        const Words t1 = select(outer1, end + n1, end - 1 - prev_e);
        const size_t room = 2 * (width - x);
        store_words(job.spikes + out + x, m - extend0 - extend1, room);
        store_words(job.start + out + x, select(extend0, begin - 1 - back, t0) | none, room);
        store_words(job.stop + out + x, select(extend1, end + ahead, t1) | none, room);
        store_words(job.count + out + x, inside, room);
    }
}

void window(const WindowJob& job) {
    const FrameLayout& g = job.layout;
    const size_t padded = g.padded_row * 8;
    uint16_t* rows[kWindowRows];
    for (int i = 0; i < kWindowRows; ++i) rows[i] = job.scratch + i * padded;
    for (size_t stored = 0; stored < g.height; ++stored) {
        Row before = row_of(job.before, g, stored);
        Row inside = row_of(job.inside, g, stored);
        Row after = row_of(job.after, g, stored);
        for (size_t column = 0; column * 8 < g.width; column += kBytes) {
            const size_t x = column * 8;
            nearest_two(job.before, before, g.msb, rows[0] + x, rows[1] + x);
            inside_window(job.inside, inside, g.msb, rows[2] + x, rows[3] + x, rows[4] + x);
            nearest_two(job.after, after, g.msb, rows[5] + x, rows[6] + x);
            before.at += kBytes;
            inside.at += kBytes;
            after.at += kBytes;
        }
        const RowState state = {rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]};
        select_edges(state, job, g.width, upright_row(g, stored) * g.width);
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

const SpikeKernels SPIKED_KERNEL_TABLE(spike_kernels) = {
    SPIKED_INSTRUCTION_SET_NAME,
#define SPIKED_KERNEL(result, name, arguments) name,
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};

}  // namespace spiked
