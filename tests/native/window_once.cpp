// Makes one spike-aligned window without Python, so that the kernels of a processor that is only emulated can be
// checked. Arguments: width, height, frames, begin, end, input of compact frames, output of spikes, start, stop and
// count (uint16).
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "../../spiked/native/spikes/kernels.hpp"

namespace {

// A run of frames from `first` on in steps of +1 or -1, padded with empty frames.
struct FrameRun {
    FrameRun(const std::vector<uint8_t>& frames, size_t bytes, int first, int step, int count)
        : empty(bytes + spiked::kMaxLoad), pointers((count + 7) / 8 * 8, empty.data()) {
        for (int i = 0; i < count; ++i) pointers[i] = frames.data() + (first + step * i) * bytes;
    }
    spiked::Run run() const { return {pointers.data(), pointers.data(), static_cast<int>(pointers.size() / 8)}; }

    std::vector<uint8_t> empty;
    std::vector<const uint8_t*> pointers;
};

}  // namespace

int main(int, char** arguments) {
    int numbers[5];
    for (int i = 0; i < 5; ++i) numbers[i] = std::atoi(arguments[1 + i]);
    const size_t width = numbers[0], height = numbers[1], bytes = width / 8 * height, pixels = width * height;
    const int count = numbers[2], begin = numbers[3], end = numbers[4];
    std::vector<uint8_t> frames(count * bytes + spiked::kMaxLoad);
    std::FILE* in = std::fopen(arguments[6], "rb");
    if (std::fread(frames.data(), 1, count * bytes, in) != count * bytes) return 2;
    std::fclose(in);
    const size_t row = width / 8, padded = (row + spiked::kMaxLoad - 1) / spiked::kMaxLoad * spiked::kMaxLoad;
    std::vector<uint16_t> out(4 * pixels), scratch(spiked::kWindowRows * padded * 8);
    const FrameRun before(frames, bytes, begin - 1, -1, begin), inside(frames, bytes, begin, 1, end - begin),
        after(frames, bytes, end, 1, count - end);
    // Rows lie one after another with room behind the last frame, so none needs a padded copy.
    const spiked::FrameLayout layout = {width, height, row, padded, height, false, false};
    spiked::spike_kernels_neon.window({layout, before.run(), inside.run(), after.run(), static_cast<uint16_t>(begin),
                                       static_cast<uint16_t>(end), scratch.data(), out.data(), out.data() + pixels,
                                       out.data() + 2 * pixels, out.data() + 3 * pixels});
    std::FILE* file = std::fopen(arguments[7], "wb");
    std::fwrite(out.data(), sizeof out[0], out.size(), file);
    std::fclose(file);
    std::puts(spiked::spike_kernels_neon.name);
}
