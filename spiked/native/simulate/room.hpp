#pragma once
#include <cstdint>
#include <vector>

namespace spiked {

struct Pinhole {
    int width, height;
    float fx, fy, cx, cy;
    float rotation[9];  // camera-to-world, row-major
    float centre[3];
};

// An oriented box; box 0 of a room is its shell, visible from inside.
struct Box {
    float centre[3];
    float axes[9];  // rows are the box's own axes in world coordinates
    float half[3];
    int textures[6];  // of the faces -x +x -y +y -z +z
};

// A pyramid of 16-bit linear intensities, finest level first, each level half the one before.
struct Texture {
    int64_t offset;  // of its finest level in the texels of the room, in texels
    int width, height, levels;
    float texels_per_unit;
};

struct Room {
    int channels;  // 1 or 3
    std::vector<Box> boxes;
    std::vector<Texture> textures;
    std::vector<uint16_t> texels;

    // Fills image [height, width, channels] and z depth [height, width]; rows are shared out over the threads.
    void render(const Pinhole& camera, float* image, float* depth, int threads) const;
};

}  // namespace spiked
