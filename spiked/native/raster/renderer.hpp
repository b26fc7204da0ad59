// Renders splats from a few sub-poses into one weighted image, and the gradients of that image.
#pragma once
#include <vector>

#include "buffer.hpp"
#include "kernels.hpp"
#include "pool.hpp"

namespace raster {

// Everything of one sub-pose that the backward pass needs again.
struct SubPose {
    View view;
    int visible = 0;
    uint32_t pairs = 0;
    Buffer<Record> records;       // [visible], by depth
    Buffer<uint32_t> first_slot;  // [splats + 1]
    Buffer<uint32_t> tile_start;  // [tiles + 1]
    Buffer<Entry> entries;        // [pairs], by tile, then depth
    Buffer<float> colour;         // [tiles][colours][kTilePixels]
    Buffer<int32_t> ends;         // [tiles][kBlocks * kMaxParts]
    Buffer<float> slots;          // [pairs][slot_floats]
};

class Renderer {
  public:
    Renderer(const Lens& lens, int threads);

    // rotations [count][9] camera to world, centres [count][3], weights [count][height][width] or null, channels
    // [height][width] or null. The splats must stay as they are until backward() is done.
    void forward(const SplatArrays&, const double* rotations, const double* centres, int count, const float* weights,
                 const uint8_t* channels, const float background[3], float* values, float* alpha, float* depth);
    void backward(const float* d_values, const GradientArrays&);

    const char* instructions() const { return kernels_.name; }
    int threads() const { return pool_.threads(); }
    const Lens& lens() const { return lens_; }
    const SplatArrays& splats() const { return splats_; }
    int sub_poses() const { return sub_poses_; }
    bool mosaic() const { return channels_ != nullptr; }
    // Blocks of 16 pixels times splats that the last forward() had to look at, at most.
    int64_t block_evaluations() const;

  private:
    void prepare();
    void project(SubPose&);
    void sort(SubPose&);
    void bin(SubPose&);
    Tile tile_of(const SubPose&, int tile, int thread);
    TileState state_of(const SubPose&, int tile) const;
    Planes planes_of(int sub_pose) const;
    void gather(const SubPose&, int first, float* sums, uint8_t* visible) const;

    const Kernels& kernels_;
    Lens lens_;
    Pool pool_;
    SplatArrays splats_{};
    int sub_poses_ = 0;
    const float* weights_ = nullptr;
    const uint8_t* channels_ = nullptr;
    std::vector<SubPose> views_;

    int stride_ = 0;
    Buffer<float> prepared_store_;
    Prepared prepared_{};
    Buffer<Record> raw_;
    Buffer<float> radius_;  // [splats], largest over the sub-poses
    Buffer<uint32_t> keys_;
    struct Item {
        uint32_t key, splat;
    };
    Buffer<Item> items_, spare_;
    struct Emission {  // of one run of ranks
        Buffer<int32_t> columns;
        Buffer<uint32_t> tile_counts;  // then where in `entries` the run's next pair of a tile goes
        std::vector<Pair> pairs;
        uint32_t size;
    };
    std::vector<Emission> emissions_;
    struct Scratch {
        Buffer<float> local;
        Buffer<uint32_t> listed;
        Buffer<uint16_t> blocks;
        Buffer<TileImage> image;
        Buffer<float> gradients;
    };
    std::vector<Scratch> scratch_;
    Buffer<double> poses_;  // [chunks][sub-poses][6]
};

}  // namespace raster
