// Whatever befalls the USB stream: no frame comes out that was not sent, none under another's index, and all indices
// are accounted for. The first byte chooses: a damaged stream of sound frames, or the fuzzer's own bytes as they are.
#include "damage.hpp"
#include "usb.hpp"

namespace {

using spiked::Event;
using spiked::Kind;
using spiked::UsbParser;

constexpr size_t most_frames = 8, view_frames = 3;
constexpr size_t stride = UsbParser::row_bytes + 2;

void store32(uint8_t* p, uint32_t value) { std::memcpy(p, &value, sizeof value); }

const std::vector<uint8_t>& pixels() {
    static const std::vector<uint8_t> all = fuzz::noise(most_frames * UsbParser::compact_bytes, 1);
    return all;
}

void append_frame(std::vector<uint8_t>& stream, size_t number, uint32_t lines, uint32_t nbytes) {
    const size_t start = stream.size();
    stream.resize(start + UsbParser::frame_bytes);
    uint8_t* p = stream.data() + start;
    store32(p, UsbParser::magic);
    store32(p + 4, 0x00100021);
    store32(p + 8, nbytes + static_cast<uint32_t>(number * UsbParser::compact_bytes));
    store32(p + 12, lines + static_cast<uint32_t>(number * UsbParser::rows));
    const uint8_t* sent = pixels().data() + number * UsbParser::compact_bytes;
    for (size_t row = 0; row < UsbParser::rows; ++row) {
        uint8_t* line = p + UsbParser::header_bytes + row * stride;
        std::memcpy(line, sent + row * UsbParser::row_bytes, UsbParser::row_bytes);
        line[UsbParser::row_bytes] = static_cast<uint8_t>(row);
        line[UsbParser::row_bytes + 1] = static_cast<uint8_t>(row >> 8);
    }
}

size_t equal_rows(const uint8_t* frame, size_t number) {
    const uint8_t* sent = pixels().data() + number * UsbParser::compact_bytes;
    size_t equal = 0;
    for (size_t at = 0; at < UsbParser::compact_bytes; at += UsbParser::row_bytes)
        equal += std::memcmp(frame + at, sent + at, UsbParser::row_bytes) == 0;
    return equal;
}

class Judge {
    UsbParser parser_;
    std::vector<uint8_t> view_ = std::vector<uint8_t>(view_frames * UsbParser::compact_bytes);
    const fuzz::Damage* damage_;
    int64_t expected_ = 0;
    int64_t offset_ = -1;

  public:
    // Without `damage` nothing is known of what was sent.
    explicit Judge(const fuzz::Damage* damage) : damage_(damage) {}

    void feed(const uint8_t* chunk, size_t bytes) {
        parser_.feed(chunk, bytes);
        drain();
    }

    void finish() {
        parser_.finish();
        drain();
        const auto& c = parser_.counters();
        fuzz::require(static_cast<int64_t>(c.received + c.lost) == parser_.next_index(),
                      "received + lost = next index");
        fuzz::require(c.bytes == c.skipped + (c.received + c.duplicates) * UsbParser::frame_bytes,
                      "all bytes are counted");
    }

  private:
    void drain() {
        for (;;) {
            const Event event = parser_.next(view_.data(), view_frames);
            if (event.kind == Kind::none) return;
            fuzz::require(event.first == expected_ && event.count > 0, "indices go on without a hole");
            expected_ += event.count;
            if (event.kind == Kind::frames && damage_)
                for (int64_t k = 0; k < event.count; ++k)
                    identify(view_.data() + static_cast<size_t>(k) * UsbParser::compact_bytes, event.first + k);
        }
    }

    void identify(const uint8_t* frame, int64_t index) {
        size_t best = 0, number = 0;
        for (size_t candidate = 0; candidate < most_frames; ++candidate) {
            const size_t equal = equal_rows(frame, candidate);
            if (equal > best) best = equal, number = candidate;
        }
        const size_t touched = damage_->flips + 2 * damage_->operations + (damage_->inserted + damage_->deleted) / 25;
        fuzz::require(best + touched >= UsbParser::rows, "a frame comes out as it was sent");
        const int64_t offset = static_cast<int64_t>(number) - index;
        fuzz::require(offset_ < 0 || offset == offset_, "each frame has its own index");
        offset_ = offset;
        fuzz::require(offset >= 0, "no frame comes before the first");
    }
};

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    fuzz::Input input(data, size);
    const uint32_t choice = input.take(1);
    const size_t step = 301 + input.take(2) % 50'000;
    std::vector<uint8_t> stream;
    fuzz::Damage damage;
    if (choice & 1) {
        stream.assign(input.rest(), input.rest() + input.left());
    } else {
        const size_t count = 2 + input.take(1) % (most_frames - 1);
        const uint32_t lines = input.take(1) & 1 ? 0u - 250u * 3u - 100u : 77u, nbytes = input.take(2);
        const uint32_t dropped = input.take(1), repeated = input.take(1);
        for (size_t number = 0; number < count; ++number) {
            if (dropped >> number & 1) continue;
            append_frame(stream, number, lines, nbytes);
            if (repeated >> number & 1) append_frame(stream, number, lines, nbytes);
        }
        damage = fuzz::spoil(stream, input, UsbParser::frame_bytes / 2);
    }
    Judge judge(choice & 1 ? nullptr : &damage);
    for (size_t at = 0; at < stream.size(); at += step)
        judge.feed(stream.data() + at, std::min(step, stream.size() - at));
    judge.finish();
    return 0;
}
