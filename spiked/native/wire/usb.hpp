// The SPS10's USB3 stream (flavour C): frames of a 16-byte header and 250 rows of 50 bytes, each with its number.
#pragma once

#include <optional>

#include "stream.hpp"

namespace spiked {

class UsbParser {
  public:
    static constexpr size_t rows = 250, row_bytes = 50, tag_bytes = 2, header_bytes = 16;
    static constexpr size_t frame_bytes = header_bytes + rows * (row_bytes + tag_bytes);
    static constexpr size_t compact_bytes = rows * row_bytes;
    static constexpr uint32_t magic = 0x63606300;

    void feed(const uint8_t* chunk, size_t bytes);
    void keep() { stream_.keep(); }
    // No more bytes follow: a frame that awaits the next header is delivered or lost by the next calls of next.
    void finish() { finished_ = true; }
    // Bytes were lost before the next chunk.
    void mark_loss();
    // The stream was interrupted and the camera may count anew: unread bytes are dropped. `lost` frames are missing by
    // the host's clock; the camera's count is used instead if it continues and differs by at most `tolerance`. If
    // called again before the next frame, the later call is used.
    void resume(int64_t lost, int64_t tolerance, Kind kind);
    // Fills `out`, of `capacity` compact frames, up to a gap or the end of the bytes.
    Event next(uint8_t* out, size_t capacity);
    const Counters& counters() const { return counters_; }
    int64_t next_index() const { return next_index_; }

  private:
    // Constants of the headers of one session, and its position.
    struct Lock {
        uint32_t word1;
        uint32_t offset;    // w2 - row_bytes w3: w2 counts the bytes of the lines that w3 counts, both modulo 2^32
        uint32_t expected;  // w3 of the frame next_index_
    };
    // A break in the stream. The next two headers show its length.
    struct Break {
        Lock former;
        int64_t lost, tolerance;
        Kind kind;
    };
    enum class Step { frame, gap, skip, starve };
    // More late frames in a row are no repetition: the camera counts anew, from a lower number. 50 ms at 20 kHz.
    static constexpr int64_t restart_frames = 1000;

    Step parse(Event& gap);
    Step synchronise(const uint8_t* p, size_t available);
    Step skip_damage(const uint8_t* p, size_t available);
    Step drop_late(int64_t ahead);
    void resume_count(const Break& broken);
    void continue_after(int64_t lost);
    std::optional<int64_t> frames_ahead(const uint8_t* header) const;
    void lock_on(const uint8_t* header);
    Event report_gap(int64_t count, Kind kind);

    Stream stream_{frame_bytes + header_bytes};
    std::optional<Lock> lock_;
    std::optional<Break> broken_;
    int64_t late_run_ = 0, late_ahead_ = 0;  // late frames in a row, and the last one's distance ahead (below 0)
    Counters counters_;
    int64_t next_index_ = 0;
    int64_t seen_index_ = -1;  // the last frame whose header was seen
    bool contiguous_ = true;   // nothing was skipped since the last frame
    bool finished_ = false;
};

}  // namespace spiked
