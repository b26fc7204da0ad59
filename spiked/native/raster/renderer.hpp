// Renders splats from a few sub-poses, or from a camera on its way past a few poses, into one weighted image, and the
// gradients of that image.
#pragma once
#include <vector>

#include "buffer.hpp"
#include "kernels.hpp"
#include "pool.hpp"

namespace raster {

// Everything of one sub-pose, or of one sub-frame on a camera's way, that the backward pass needs again.
struct SubPose {
    View view;
    Passage passage;
    int visible = 0;
    uint32_t pairs = 0;
    Buffer<Record> records;       // [visible], by depth
    Buffer<Motion> motions;       // [visible], by depth; while the camera moves
    Buffer<uint32_t> first_pair;  // [splats + 1]
    Buffer<uint32_t> places;      // [pairs] by splat: which of the entries it is
    Buffer<uint32_t> tile_start;  // [tiles + 1]
    Buffer<Entry> entries;        // [pairs], by tile, then depth
    Buffer<float> colour;         // [tiles][colours][kTilePixels]
    Buffer<int32_t> ends;         // [tiles][kBlocks * kMaxParts]
    Buffer<float> slots;          // [pairs][slot_floats], by tile
};

// What to see the splats from, and when.
struct Views {
    const double *rotations, *centres;  // [count][9] camera to world, [count][3]
    int count;
    const float* weights;  // [count][height][width] or null
    // Not null when the camera moves from pose to pose, each the end of a sub-frame and the beginning of the next one:
    // [height][width], when each pixel's window begins and ends, in sub-frames from the first pose.
    const float *start, *stop;
    const uint8_t* channels;  // [height][width] or null
};

class Renderer {
  public:
    Renderer(const Lens& lens, int threads);

    // The splats and the planes of the views must stay as they are until backward() is done.
    void forward(const SplatArrays&, const Views&, const float background[3], float* values, float* alpha,
                 float* depth);
    void backward(const float* d_values, const GradientArrays&);

    const char* instructions() const { return kernels_.name; }
    int threads() const { return pool_.threads(); }
    const Lens& lens() const { return lens_; }
    const SplatArrays& splats() const { return splats_; }
    int poses() const { return planes_.count; }
    bool mosaic() const { return planes_.channels != nullptr; }
    // Blocks of 16 pixels times splats that the last forward() had to look at, at most.
    int64_t block_evaluations() const;

  private:
    void prepare();
    void set_passages();
    void project(SubPose&);
    void sort(SubPose&);
    void bin(SubPose&);
    Tile tile_of(const SubPose&, int tile, int thread);
    TileState state_of(const SubPose&, int tile) const;
    Planes planes_of(int sub_pose) const;
    void gather(const SubPose&, int first, float* sums, uint8_t* visible) const;
    bool moving() const { return planes_.start != nullptr; }
    int slot_floats() const { return raster::slot_floats(splats_.colours, moving()); }

    const Kernels& kernels_;
    Lens lens_;
    Pool pool_;
    SplatArrays splats_{};
    Views planes_{};     // of which only the planes outlive forward()
    int sub_poses_ = 0;  // or sub-frames
    std::vector<SubPose> views_;

    int stride_ = 0;
    Buffer<float> prepared_store_;
    Prepared prepared_{};
    Buffer<Record> raw_;
    Buffer<Motion> raw_motions_;
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
    Buffer<double> poses_;  // [chunks][poses][6]
};

}  // namespace raster
