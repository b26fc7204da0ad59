#include "pcie.hpp"

namespace spiked {
namespace {

constexpr uint16_t first_tag = 500, last_tag = 500 | 3 << 10;

uint16_t tag(const uint8_t* half) { return static_cast<uint16_t>(load16(half + 62) >> 4); }

// Two half-lines of 500 pixels to a row of 125 bytes; the second begins in the middle of byte 62. Writes 125 bytes.
inline void copy_row(const uint8_t* half, uint8_t* out) {
    const uint8_t* second = half + PcieParser::half_bytes;
    std::memcpy(out, half, 62);
    uint64_t carry = half[62] & 0x0F;
    for (size_t k = 0; k < 7; ++k) {
        const uint64_t word = load64(second + 8 * k);
        store64(out + 62 + 8 * k, word << 4 | carry);
        carry = word >> 60;
    }
    const uint64_t tail = load64(second + 56) << 4 | carry;
    std::memcpy(out + 118, &tail, 7);
}

PcieParser::Tags read_tags(const uint8_t* frame) {
    PcieParser::Tags tags;
    for (size_t i = 0; i < PcieParser::halves; ++i) tags[i] = tag(frame + i * PcieParser::half_bytes);
    return tags;
}

// Whether the tags are every line of every channel once, from line 500 of channel 0 to line 500 of channel 3.
bool is_order(const PcieParser::Tags& tags) {
    std::array<bool, 4096> seen{};
    for (const uint16_t value : tags) {
        const unsigned line = value & 1023;
        if (line < 1 || line > 500 || seen[value]) return false;
        seen[value] = true;
    }
    return tags.front() == first_tag && tags.back() == last_tag;
}

// Copies a frame. Returns whether all its tags are those of the order.
bool copy_frame(const uint8_t* frame, const PcieParser::Tags& order, uint8_t* out) {
    unsigned wrong = 0;
    for (size_t row = 0; row < PcieParser::rows; ++row) {
        const uint8_t* half = frame + 2 * row * PcieParser::half_bytes;
        wrong |= tag(half) ^ order[2 * row];
        wrong |= tag(half + PcieParser::half_bytes) ^ order[2 * row + 1];
        copy_row(half, out + row * 125);
    }
    return wrong == 0;
}

}  // namespace

void PcieParser::feed(const uint8_t* chunk, size_t bytes) {
    if (finished_) throw std::logic_error("a finished stream takes no more bytes");
    stream_.feed(chunk, bytes);
    counters_.bytes += bytes;
}

Event PcieParser::next(uint8_t* out, size_t capacity) {
    Event frames{Kind::frames, next_index_, 0};
    while (static_cast<size_t>(frames.count) < capacity) {
        const Step step = parse(out + static_cast<size_t>(frames.count) * compact_bytes);
        if (step == Step::frame) {
            stream_.advance(frame_bytes);
            ++next_index_;
            ++counters_.received;
            ++frames.count;
            skipped_since_frame_ = 0;
        } else if (step == Step::gap) {
            if (frames.count) return frames;
            const Event gap{Kind::host_gap, next_index_, lost_frames()};
            next_index_ += gap.count;
            counters_.lost += static_cast<uint64_t>(gap.count);
            contiguous_ = true;
            skipped_since_frame_ = 0;
            return gap;
        } else if (step == Step::starve) {
            break;
        }
    }
    return frames.count ? frames : Event{};
}

PcieParser::Step PcieParser::parse(uint8_t* out) {
    const uint8_t* p = stream_.data();
    const size_t available = stream_.available();
    if (available < half_bytes) {
        if (finished_) {
            counters_.skipped += available;
            stream_.advance(available);
        }
        return Step::starve;
    }
    if (tag(p) != first_tag) return skip_damage(p, available);
    if (available < frame_bytes || (!learned_ && !finished_ && available < 2 * frame_bytes))
        return finished_ ? skip_damage(p, available) : Step::starve;
    if (!learned_ && !learn_order(p, available)) return skip_damage(p, available);
    if (!copy_frame(p, order_, out)) return skip_damage(p, available);
    return contiguous_ || counters_.received == 0 ? Step::frame : Step::gap;
}

// The order of lines and channels is not published. It is taken from two whole frames that agree, or from one at the
// end of a stream.
bool PcieParser::learn_order(const uint8_t* p, size_t available) {
    const Tags order = read_tags(p);
    if (!is_order(order)) return false;
    if (available >= 2 * frame_bytes && read_tags(p + frame_bytes) != order) return false;
    order_ = order;
    learned_ = true;
    contiguous_ = true;
    return true;
}

// Skips to the next possible start of a frame: line 500 of channel 0 after line 500 of channel 3. Damage may have any
// length, so every byte is searched.
PcieParser::Step PcieParser::skip_damage(const uint8_t* p, size_t available) {
    if (learned_ && contiguous_) {
        ++counters_.resyncs;
        contiguous_ = false;
    }
    if (available < 2 * half_bytes && !finished_) return Step::starve;
    constexpr uint8_t last_high = last_tag >> 4;
    // The remaining bytes may be the start of these two half-lines.
    size_t skip = finished_ ? available : available - 2 * half_bytes + 1;
    const uint8_t* end = p + available - half_bytes;
    for (const uint8_t* at = p; at + half_bytes <= end; ++at) {
        const void* found = memchr(at + half_bytes - 1, last_high, static_cast<size_t>(end - at) - (half_bytes - 1));
        if (!found) break;
        at = static_cast<const uint8_t*>(found) - (half_bytes - 1);
        if (tag(at) == last_tag && tag(at + half_bytes) == first_tag) {
            skip = static_cast<size_t>(at - p) + half_bytes;
            break;
        }
    }
    counters_.skipped += skip;
    skipped_since_frame_ += skip;
    stream_.advance(skip);
    return Step::skip;
}

// The stream has no frame counter: one frame for each 128,000 skipped bytes, rounded, and at least one.
int64_t PcieParser::lost_frames() const {
    return std::max<int64_t>(1, static_cast<int64_t>((skipped_since_frame_ + frame_bytes / 2) / frame_bytes));
}

}  // namespace spiked
