// A byte stream that arrives in chunks of any size and is read in contiguous pieces. Only the seams are copied.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

namespace spiked {

inline uint16_t load16(const uint8_t* p) {
    uint16_t value;
    std::memcpy(&value, p, sizeof value);
    return value;
}
inline uint32_t load32(const uint8_t* p) {
    uint32_t value;
    std::memcpy(&value, p, sizeof value);
    return value;
}
inline uint64_t load64(const uint8_t* p) {
    uint64_t value;
    std::memcpy(&value, p, sizeof value);
    return value;
}
inline void store64(uint8_t* p, uint64_t value) { std::memcpy(p, &value, sizeof value); }

class Stream {
    size_t window_;              // largest number of bytes that are read ahead
    std::vector<uint8_t> seam_;  // the unread tail of earlier chunks, and the beginning of this one while it is needed
    size_t seam_tail_ = 0;       // how much of the seam is from earlier chunks
    size_t cursor_ = 0;          // in the seam while it is not empty, else in the chunk
    const uint8_t* chunk_ = nullptr;
    size_t chunk_bytes_ = 0;

    bool in_seam() const { return !seam_.empty(); }

  public:
    explicit Stream(size_t window) : window_(window) { seam_.reserve(2 * window); }

    // The chunk must stay valid until the next call of feed or keep.
    void feed(const uint8_t* chunk, size_t bytes) {
        keep();
        chunk_ = chunk;
        chunk_bytes_ = bytes;
        seam_tail_ = seam_.size();
        seam_.insert(seam_.end(), chunk, chunk + (in_seam() ? std::min(bytes, window_) : 0));
    }

    // Copies the unread rest of the chunk, which may then be freed.
    void keep() {
        if (in_seam()) {
            const size_t seen = seam_.size() - seam_tail_;
            seam_.erase(seam_.begin(), seam_.begin() + static_cast<ptrdiff_t>(cursor_));
            seam_.insert(seam_.end(), chunk_ + seen, chunk_ + chunk_bytes_);
        } else {
            seam_.assign(chunk_ + cursor_, chunk_ + chunk_bytes_);
        }
        cursor_ = 0;
        chunk_ = nullptr;
        chunk_bytes_ = 0;
        seam_tail_ = seam_.size();
    }

    const uint8_t* data() const { return (in_seam() ? seam_.data() : chunk_) + cursor_; }
    // Contiguous bytes at data(): as many as there are, or at least a window.
    size_t available() const { return (in_seam() ? seam_.size() : chunk_bytes_) - cursor_; }

    void advance(size_t bytes) {
        if (bytes > available()) throw std::logic_error("a stream was read beyond its end");
        cursor_ += bytes;
        if (in_seam() && cursor_ >= seam_tail_) {
            cursor_ -= seam_tail_;
            seam_.clear();
            seam_tail_ = 0;
        }
    }
};

enum class Kind { none, frames, device_gap, host_gap };

// `count` frames from index `first` on, delivered or lost.
struct Event {
    Kind kind = Kind::none;
    int64_t first = 0;
    int64_t count = 0;
};

struct Counters {
    uint64_t bytes = 0;       // fed
    uint64_t received = 0;    // frames delivered
    uint64_t lost = 0;        // frames reported in gaps
    uint64_t duplicates = 0;  // frames that came again or late and were dropped
    uint64_t skipped = 0;     // bytes that belong to no delivered or duplicated frame
    uint64_t resyncs = 0;     // times that synchronisation was lost
    uint64_t restarts = 0;    // times that the camera's counters started anew
};

}  // namespace spiked
