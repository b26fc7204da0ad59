// The SPS10's USB3 stream (flavour C): frames of a 16-byte header and 250 rows of 50 bytes, each with its number.
#pragma once

#include <optional>

#include "stream.hpp"

namespace spiked::wire {

class UsbParser {
  public:
    static constexpr size_t rows = 250, row_bytes = 50, header_bytes = 16;
    static constexpr size_t frame_bytes = header_bytes + rows * (row_bytes + 2);
    static constexpr size_t compact_bytes = rows * row_bytes;
    static constexpr uint32_t magic = 0x63606300;

    void feed(const uint8_t* chunk, size_t bytes);
    void keep() { stream_.keep(); }
    // No more bytes come: what is held back for want of its successor is delivered or lost by the next calls of next.
    void finish() { finished_ = true; }
    // Bytes were lost before the next chunk.
    void mark_loss();
    // The stream broke off, and what comes next may come from a camera that counts anew: unread bytes are dropped.
    // `lost` frames are missing by the host's clock; the camera's own count is taken instead if it runs on and differs
    // by at most `tolerance`. Called again before a frame came, the later call counts.
    void resume(int64_t lost, int64_t tolerance, Kind kind);
    // Fills `out`, of `capacity` compact frames, as far as it goes before a gap or the end of the bytes.
    Event next(uint8_t* out, size_t capacity);
    const Counters& counters() const { return counters_; }
    int64_t next_index() const { return next_index_; }

  private:
    // What the headers of one session share, and where it stands.
    struct Lock {
        uint32_t word1;
        uint32_t offset;    // w2 - 50 w3: both count the same lines, and modulo 2^32 this never changes
        uint32_t expected;  // w3 of the frame next_index_
    };
    // A break in the stream whose length the next two headers tell.
    struct Break {
        Lock former;
        int64_t lost, tolerance;
        Kind kind;
    };
    enum class Step { frame, gap, skip, starve };
    // So many frames in a row that are all late are no repetition: the camera counts anew, from a number below.
    static constexpr int64_t anew_frames = 1000;

    Step look(Event& gap);
    Step look_for_lock(const uint8_t* p, size_t available);
    Step damaged(const uint8_t* p, size_t available);
    Step late(int64_t ahead);
    void come_back(const Break& broken);
    void go_on_after(int64_t lost);
    std::optional<int64_t> frames_ahead(const uint8_t* header) const;
    void lock_on(const uint8_t* header);
    Event lose(int64_t count, Kind kind);

    Stream stream_{frame_bytes + header_bytes};
    std::optional<Lock> lock_;
    std::optional<Break> broken_;
    int64_t late_run_ = 0, late_ahead_ = 0;  // frames in a row that were late, and how far ahead (below 0) the last was
    Counters counters_;
    int64_t next_index_ = 0;
    int64_t seen_index_ = -1;  // the last frame whose header was seen
    bool contiguous_ = true;   // nothing was skipped since the last frame
    bool finished_ = false;
};

}  // namespace spiked::wire
