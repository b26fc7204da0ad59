// Reduces one block of eight frames without Python, so that the kernels of a processor that is only emulated can be
// checked. Arguments: width, height, input of eight compact frames, output of counts, first and last offsets.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "../../spiked/native/blocks/kernels.hpp"

int main(int, char** arguments) {
    const size_t width = std::atoi(arguments[1]), height = std::atoi(arguments[2]), bytes = width / 8 * height;
    std::vector<uint8_t> frames(8 * bytes + spiked::kMaxLoad * 64), out(3 * width * height);
    std::FILE* in = std::fopen(arguments[3], "rb");
    if (std::fread(frames.data(), 1, 8 * bytes, in) != 8 * bytes) return 2;
    std::fclose(in);
    const uint8_t* pointers[8];
    for (int f = 0; f < 8; ++f) pointers[f] = frames.data() + f * bytes;
    const size_t row = width / 8, padded = (row + spiked::kMaxLoad - 1) / spiked::kMaxLoad * spiked::kMaxLoad;
    const spiked::Kernels& kernels = *spiked::neon_kernels();
    kernels.reduce({{width, height, row, padded, height, false, false},
                    {pointers, pointers, 1},
                    out.data(),
                    out.data() + width * height,
                    out.data() + 2 * width * height});
    std::FILE* file = std::fopen(arguments[4], "wb");
    std::fwrite(out.data(), 1, out.size(), file);
    std::fclose(file);
    std::puts(kernels.name);
}
