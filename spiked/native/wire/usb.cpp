#include "usb.hpp"

#include <cstdlib>

namespace spiked {
namespace {

constexpr size_t stride = UsbParser::row_bytes + UsbParser::tag_bytes;
// Bytes from the begin of a header to its words: a constant of the session, bytes and lines so far.
constexpr size_t word1_at = 4, bytes_at = 8, lines_at = 12;

bool has_magic(const uint8_t* p) { return load32(p) == UsbParser::magic; }
uint32_t session_offset(const uint8_t* header) {
    return load32(header + bytes_at) - static_cast<uint32_t>(UsbParser::row_bytes) * load32(header + lines_at);
}

// Whether the complete rows among `bytes` bytes from the header on have the numbers 0, 1, 2, ...
bool rows_run(const uint8_t* header, size_t bytes) {
    const uint8_t* tag = header + UsbParser::header_bytes + UsbParser::row_bytes;
    const size_t whole = std::min(UsbParser::rows, (bytes - UsbParser::header_bytes) / stride);
    for (size_t row = 0; row < whole; ++row)
        if (load16(tag + row * stride) != row) return false;
    return true;
}

void copy_rows(const uint8_t* header, uint8_t* out) {
    const uint8_t* row = header + UsbParser::header_bytes;
    for (size_t i = 0; i < UsbParser::rows; ++i)
        std::memcpy(out + i * UsbParser::row_bytes, row + i * stride, UsbParser::row_bytes);
}

// Frames from counter `from` to `to`. Lines are counted modulo 2^32, which is no multiple of 250: only one direction
// gives whole frames, so a step back is never mistaken for a long step forward.
std::optional<int64_t> frames_between(uint32_t from, uint32_t to) {
    const uint32_t ahead = to - from, back = from - to;
    if (ahead % UsbParser::rows == 0) return ahead / UsbParser::rows;
    if (back % UsbParser::rows == 0) return -static_cast<int64_t>(back / UsbParser::rows);
    return std::nullopt;
}

}  // namespace

void UsbParser::feed(const uint8_t* chunk, size_t bytes) {
    if (finished_) throw std::logic_error("a finished stream takes no more bytes");
    stream_.feed(chunk, bytes);
    counters_.bytes += bytes;
}

void UsbParser::mark_loss() { contiguous_ = false; }

void UsbParser::resume(int64_t lost, int64_t tolerance, Kind kind) {
    counters_.skipped += stream_.available();
    stream_.keep();
    stream_.advance(stream_.available());
    if (lock_)
        broken_ = Break{*lock_, lost, tolerance, kind};
    else if (broken_)
        broken_ = Break{broken_->former, lost, tolerance, kind};
    lock_.reset();
    contiguous_ = true;
}

Event UsbParser::next(uint8_t* out, size_t capacity) {
    Event frames{Kind::frames, next_index_, 0};
    while (static_cast<size_t>(frames.count) < capacity) {
        Event gap;
        const Step step = parse(gap);
        if (step == Step::frame) {
            copy_rows(stream_.data(), out + static_cast<size_t>(frames.count) * compact_bytes);
            stream_.advance(frame_bytes);
            seen_index_ = std::max(seen_index_, next_index_);
            ++next_index_;
            ++counters_.received;
            ++frames.count;
            lock_->expected += rows;
            contiguous_ = true;
        } else if (step == Step::gap || step == Step::starve) {
            if (step == Step::starve && finished_ && frames.count == 0 && seen_index_ >= next_index_)
                return report_gap(seen_index_ + 1 - next_index_, Kind::host_gap);
            // The next call finds the gap again, after the frames before it.
            if (frames.count == 0) return step == Step::gap ? report_gap(gap.count, gap.kind) : Event{};
            return frames;
        }
    }
    return frames.count ? frames : Event{};
}

// Classifies the next bytes without delivering them; skips bytes of no frame.
UsbParser::Step UsbParser::parse(Event& gap) {
    const uint8_t* p = stream_.data();
    const size_t available = stream_.available();
    if (available < header_bytes) {
        if (finished_) {
            counters_.skipped += available;
            stream_.advance(available);
        }
        return Step::starve;
    }
    if (!has_magic(p)) return skip_damage(p, available);
    const std::optional<int64_t> ahead = lock_ ? frames_ahead(p) : std::nullopt;
    if (!ahead) return synchronise(p, available);
    const bool sound = rows_run(p, available);
    if (*ahead >= 0) {
        seen_index_ = std::max(seen_index_, next_index_ + *ahead);
        // The header alone shows what the camera did not send. Behind damage the loss is the host's.
        if (*ahead > 0 && (contiguous_ || (sound && available >= frame_bytes))) {
            gap = Event{contiguous_ ? Kind::device_gap : Kind::host_gap, next_index_, *ahead};
            return Step::gap;
        }
    }
    if (!sound || (finished_ && available < frame_bytes)) return skip_damage(p, available);
    if (available < frame_bytes) return Step::starve;
    if (*ahead < 0) return drop_late(*ahead);
    late_run_ = 0;
    return Step::frame;
}

UsbParser::Step UsbParser::drop_late(int64_t ahead) {
    late_run_ = late_run_ && ahead == late_ahead_ + 1 ? late_run_ + 1 : 1;
    late_ahead_ = ahead;
    if (late_run_ > restart_frames) {
        ++counters_.restarts;
        counters_.duplicates -= restart_frames;
        counters_.skipped += restart_frames * frame_bytes;
        lock_->expected += static_cast<uint32_t>(ahead) * static_cast<uint32_t>(rows);
        continue_after(restart_frames);
        contiguous_ = true;
        return Step::skip;
    }
    ++counters_.duplicates;
    stream_.advance(frame_bytes);
    return Step::skip;
}

// A first frame is accepted if its rows are right and the next header follows and agrees: a lone header may be junk.
UsbParser::Step UsbParser::synchronise(const uint8_t* p, size_t available) {
    if (!rows_run(p, available)) return skip_damage(p, available);
    const bool whole = available >= frame_bytes;
    if (available < frame_bytes + header_bytes) {
        if (!finished_) return Step::starve;
        if (!whole || lock_ || broken_) return skip_damage(p, available);
        lock_on(p);
        return Step::frame;
    }
    const uint8_t* following = p + frame_bytes;
    const auto step = frames_between(load32(p + lines_at), load32(following + lines_at));
    const bool confirmed = has_magic(following) && load32(p + word1_at) == load32(following + word1_at) &&
                           session_offset(p) == session_offset(following) && step && *step > 0;
    if (!confirmed) return skip_damage(p, available);
    const bool again = lock_.has_value();
    lock_on(p);
    if (broken_) {
        resume_count(*broken_);
        return Step::skip;
    }
    if (!again) return Step::frame;
    // The camera restarted by itself. Its counters do not show for how long; at least one frame is lost.
    ++counters_.restarts;
    continue_after(1);
    contiguous_ = true;
    return Step::skip;
}

void UsbParser::resume_count(const Break& broken) {
    const bool same = broken.former.word1 == lock_->word1 && broken.former.offset == lock_->offset;
    const auto ahead = same ? frames_between(broken.former.expected, lock_->expected) : std::nullopt;
    if (ahead && *ahead >= 0 && std::abs(*ahead - broken.lost) <= broken.tolerance) {
        lock_->expected = broken.former.expected;
    } else {
        ++counters_.restarts;
        continue_after(std::max<int64_t>(1, broken.lost));
    }
    contiguous_ = broken.kind == Kind::device_gap;
    broken_.reset();
}

// The next frame of the lock follows `lost` lost ones, and all frames whose header was seen.
void UsbParser::continue_after(int64_t lost) {
    lost = std::max(lost, seen_index_ + 1 - next_index_);
    lock_->expected -= static_cast<uint32_t>(lost) * static_cast<uint32_t>(rows);
    late_run_ = 0;
}

// Skips to the next possible start of a header. Damage may have any length, so a header may start at any byte, not only
// at the multiples of 4 at which the camera sends.
UsbParser::Step UsbParser::skip_damage(const uint8_t* p, size_t available) {
    static constexpr uint8_t pattern[4] = {0x00, 0x63, 0x60, 0x63};
    if (contiguous_ && lock_) ++counters_.resyncs;
    if (lock_) contiguous_ = false;
    const void* found = memmem(p + 1, available - 1, pattern, sizeof pattern);
    const size_t skip = found ? static_cast<size_t>(static_cast<const uint8_t*>(found) - p) : available - 3;
    counters_.skipped += skip;
    stream_.advance(skip);
    return Step::skip;
}

std::optional<int64_t> UsbParser::frames_ahead(const uint8_t* header) const {
    if (load32(header + word1_at) != lock_->word1 || session_offset(header) != lock_->offset) return std::nullopt;
    return frames_between(lock_->expected, load32(header + lines_at));
}

void UsbParser::lock_on(const uint8_t* header) {
    lock_ = Lock{load32(header + word1_at), session_offset(header), load32(header + lines_at)};
}

Event UsbParser::report_gap(int64_t count, Kind kind) {
    const Event gap{kind, next_index_, count};
    next_index_ += count;
    counters_.lost += static_cast<uint64_t>(count);
    if (lock_) lock_->expected += static_cast<uint32_t>(count) * static_cast<uint32_t>(rows);
    return gap;
}

}  // namespace spiked
