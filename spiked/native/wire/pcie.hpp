// The M1K40's raw stream (flavour E): frames of 1000 rows of two half-lines of 64 bytes, each with a line and a
// channel.
#pragma once

#include <array>

#include "stream.hpp"

namespace spiked {

class PcieParser {
  public:
    static constexpr size_t rows = 1000, half_bytes = 64, halves = 2 * rows;
    static constexpr size_t frame_bytes = halves * half_bytes;
    static constexpr size_t compact_bytes = rows * 125;
    using Tags = std::array<uint16_t, halves>;  // bits 0-9 line, 10-11 channel, in the order of a frame

    void feed(const uint8_t* chunk, size_t bytes);
    void keep() { stream_.keep(); }
    // No more bytes follow: a frame that awaits its successor is delivered by the next call of next.
    void finish() { finished_ = true; }
    // Bytes were lost before the next chunk.
    void mark_loss() { contiguous_ = false; }
    // Fills `out`, of `capacity` compact frames, up to a gap or the end of the bytes.
    Event next(uint8_t* out, size_t capacity);
    const Counters& counters() const { return counters_; }
    int64_t next_index() const { return next_index_; }

  private:
    enum class Step { frame, gap, skip, starve };

    Step parse(uint8_t* out);
    bool learn_order(const uint8_t* p, size_t available);
    Step skip_damage(const uint8_t* p, size_t available);
    int64_t lost_frames() const;

    Stream stream_{2 * frame_bytes};
    Tags order_{};
    bool learned_ = false;
    Counters counters_;
    int64_t next_index_ = 0;
    uint64_t skipped_since_frame_ = 0;
    bool contiguous_ = true;  // nothing was skipped or lost since the last frame
    bool finished_ = false;
};

}  // namespace spiked
