// Whatever befalls the raw PCIe stream: each frame that comes out is one that was sent, in their order, and all indices
// are accounted for. The first byte chooses: a damaged stream of sound frames, or the fuzzer's own bytes as they are.
#include "damage.hpp"
#include "pcie.hpp"

namespace {

using spiked::Event;
using spiked::Kind;
using spiked::PcieParser;

constexpr size_t most_frames = 4, view_frames = 2;

// Half-lines in the order of the sensor: line 500 channels 0 and 1, ..., in the end line 500 channels 2 and 3.
std::vector<uint8_t> frame(size_t number) {
    std::vector<uint8_t> data = fuzz::noise(PcieParser::frame_bytes, number + 1);
    for (size_t half = 0; half < PcieParser::halves; ++half) {
        uint8_t* tag = data.data() + half * PcieParser::half_bytes + 62;
        const size_t row = half / 2;
        const uint32_t line = row < 500 ? 500 - row : row - 499;
        const uint32_t channel = (row < 500 ? 0 : 2) + half % 2;
        const uint32_t word = line | channel << 10;
        tag[0] = static_cast<uint8_t>((tag[0] & 0x0F) | word << 4);
        tag[1] = static_cast<uint8_t>(word >> 4);
    }
    return data;
}

const std::vector<uint8_t>& sent(size_t number) {
    static const std::vector<std::vector<uint8_t>> all = {frame(0), frame(1), frame(2), frame(3)};
    return all[number];
}

std::vector<uint8_t> compact(size_t number) {
    PcieParser parser;
    std::vector<uint8_t> twice = sent(number), out(PcieParser::compact_bytes);
    twice.insert(twice.end(), sent(number).begin(), sent(number).end());
    parser.feed(twice.data(), twice.size());
    const Event event = parser.next(out.data(), 1);
    fuzz::require(event.kind == Kind::frames, "a sound frame is found");
    return out;
}

const std::vector<uint8_t>& expected(size_t number) {
    static const std::vector<std::vector<uint8_t>> all = {compact(0), compact(1), compact(2), compact(3)};
    return all[number];
}

size_t equal_rows(const uint8_t* one, size_t number) {
    const uint8_t* other = expected(number).data();
    size_t equal = 0;
    for (size_t at = 0; at < PcieParser::compact_bytes; at += 125) equal += std::memcmp(one + at, other + at, 125) == 0;
    return equal;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    fuzz::Input input(data, size);
    const uint32_t choice = input.take(1);
    const size_t step = 4099 + input.take(3) % 400'000;
    std::vector<uint8_t> stream;
    fuzz::Damage damage;
    if (choice & 1) {
        stream.assign(input.rest(), input.rest() + input.left());
    } else {
        const size_t count = 2 + input.take(1) % (most_frames - 1);
        for (size_t number = 0; number < count; ++number)
            stream.insert(stream.end(), sent(number).begin(), sent(number).end());
        damage = fuzz::spoil(stream, input, PcieParser::frame_bytes / 2);
    }
    PcieParser parser;
    std::vector<uint8_t> view(view_frames * PcieParser::compact_bytes);
    int64_t next = 0;
    size_t last = 0;
    const auto drain = [&] {
        for (;;) {
            const Event event = parser.next(view.data(), view_frames);
            if (event.kind == Kind::none) return;
            fuzz::require(event.first == next && event.count > 0, "indices go on without a hole");
            next += event.count;
            for (int64_t k = 0; !(choice & 1) && event.kind == Kind::frames && k < event.count; ++k) {
                size_t best = 0, number = 0;
                for (size_t candidate = 0; candidate < most_frames; ++candidate) {
                    const size_t equal =
                        equal_rows(view.data() + static_cast<size_t>(k) * PcieParser::compact_bytes, candidate);
                    if (equal > best) best = equal, number = candidate;
                }
                const size_t touched = damage.flips + 2 * damage.operations + (damage.inserted + damage.deleted) / 60;
                fuzz::require(best + touched >= PcieParser::rows, "a frame comes out as it was sent");
                fuzz::require(number >= last, "frames come in their order");
                last = number;
            }
        }
    };
    for (size_t at = 0; at < stream.size(); at += step) {
        parser.feed(stream.data() + at, std::min(step, stream.size() - at));
        drain();
    }
    parser.finish();
    drain();
    const auto& c = parser.counters();
    fuzz::require(static_cast<int64_t>(c.received + c.lost) == parser.next_index(), "received + lost = next index");
    return 0;
}
