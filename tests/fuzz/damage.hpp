// Reads a fuzzer's bytes as a list of things that befall a byte stream.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

namespace fuzz {

// The sanitizers' way of failing: the input is kept and shown.
inline void require(bool condition, const char* what) {
    if (condition) return;
    std::fprintf(stderr, "violated: %s\n", what);
    std::abort();
}

class Input {
    const uint8_t* data_;
    size_t left_;

  public:
    Input(const uint8_t* data, size_t size) : data_(data), left_(size) {}
    bool empty() const { return left_ == 0; }
    size_t left() const { return left_; }
    const uint8_t* rest() const { return data_; }
    uint32_t take(size_t bytes) {
        uint32_t value = 0;
        for (; bytes && left_; --bytes, --left_) value = value << 8 | *data_++;
        return value;
    }
};

inline uint64_t next_random(uint64_t& state) {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

inline std::vector<uint8_t> noise(size_t bytes, uint64_t seed) {
    uint64_t state = seed * 0x9E3779B97F4A7C15u + 1;
    std::vector<uint8_t> data(bytes);
    for (auto& byte : data) byte = static_cast<uint8_t>(next_random(state) >> 32);
    return data;
}

struct Damage {
    size_t flips = 0, operations = 0, inserted = 0, deleted = 0;
};

// Flips, deletions, insertions and repetitions, at most `budget` bytes of them: a loss or a repetition of exactly a
// frame's bytes from within one frame to within the next cannot be seen on a wire without checksums.
inline Damage spoil(std::vector<uint8_t>& stream, Input& input, size_t budget) {
    Damage damage;
    while (!input.empty() && damage.operations < 12 && stream.size() > 64) {
        const uint32_t kind = input.take(1);
        const size_t at = input.take(3) % stream.size();
        const size_t span = 1 + input.take(2) % 2048;
        ++damage.operations;
        const auto place = stream.begin() + static_cast<std::ptrdiff_t>(at);
        switch (kind % 5) {
            case 0:
                stream[at] ^= static_cast<uint8_t>(1 + span % 255);
                ++damage.flips;
                break;
            case 1: {
                const size_t count = std::min({span, stream.size() - at, budget - damage.deleted});
                stream.erase(place, place + static_cast<std::ptrdiff_t>(count));
                damage.deleted += count;
                break;
            }
            case 2: {
                const auto junk = noise(std::min(span, budget - damage.inserted), span);
                stream.insert(place, junk.begin(), junk.end());
                damage.inserted += junk.size();
                break;
            }
            case 3: {
                const size_t count = std::min({span, at, budget - damage.inserted});
                const std::vector<uint8_t> again(place - static_cast<std::ptrdiff_t>(count), place);
                stream.insert(place, again.begin(), again.end());
                damage.inserted += count;
                break;
            }
            case 4:
                stream.resize(std::max(at, stream.size() / 2));
                break;
        }
    }
    return damage;
}

}  // namespace fuzz
