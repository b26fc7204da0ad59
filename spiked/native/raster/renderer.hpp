// Renders splats from a few sub-poses, or from a camera that moves through a few poses, into one weighted image, and
// the gradients of that image.
#pragma once
#include <vector>

#include "../common/pool.hpp"
#include "buffer.hpp"
#include "kernels.hpp"

namespace spiked {

inline View view_of(const double* rotation, const double* centre) {
    View view;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) view.rotation[3 * i + j] = static_cast<float>(rotation[3 * j + i]);
        view.centre_high[i] = static_cast<float>(centre[i]);
        view.centre_low[i] = static_cast<float>(centre[i] - view.centre_high[i]);
    }
    return view;
}

// State of one sub-pose, or of one sub-frame of a moving camera, that the backward pass reuses.
struct SubPose {
    View view;
    SubFrame sub_frame;
    int visible = 0;
    uint32_t pairs = 0;
    Buffer<ProjectedSplat> records;  // [visible], by depth
    Buffer<Motion> motions;          // [visible], by depth; while the camera moves
    Buffer<uint32_t> first_pair;     // [splats + 1]
    Buffer<uint32_t> places;         // [pairs] by splat: which of the entries it is
    Buffer<uint32_t> tile_start;     // [tiles + 1]
    Buffer<TileEntry> entries;       // [pairs], by tile, then depth
    Buffer<float> colour;            // [tiles][colours][kTilePixels]
    Buffer<int32_t> ends;            // [tiles][kBlocks * kMaxParts]
    Buffer<float> slots;             // [pairs][slot_floats], by tile
};

// Poses and exposure windows to render from.
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
    Renderer(const PinholeF& camera, int threads);

    // The splats and the planes of the views must stay as they are until backward() is done.
    void forward(const SplatArrays&, const Views&, const float background[3], float* values, float* alpha,
                 float* depth);
    void backward(const float* d_values, const GradientArrays&);

    const char* instructions() const { return kernels_.name; }
    int threads() const { return pool_.threads(); }
    const PinholeF& camera() const { return camera_; }
    const SplatArrays& splats() const { return splats_; }
    int poses() const { return planes_.count; }
    bool mosaic() const { return planes_.channels != nullptr; }
    // Upper bound of the blocks of 16 pixels times splats that the last forward() evaluated.
    int64_t block_evaluations() const;

  private:
    void prepare();
    void set_sub_frames();
    void project(SubPose&);
    void sort(SubPose&);
    void bin(SubPose&);
    Tile tile_of(const SubPose&, int tile, int thread);
    TileState state_of(const SubPose&, int tile) const;
    Planes planes_of(int sub_pose) const;
    void gather(const SubPose&, int first, float* sums, uint8_t* visible) const;
    bool moving() const { return planes_.start != nullptr; }
    int slot_floats() const { return spiked::slot_floats(splats_.colours, moving()); }

    const RasterKernels& kernels_;
    PinholeF camera_;
    Pool pool_;
    SplatArrays splats_{};
    Views planes_{};     // only its planes are used after forward()
    int sub_poses_ = 0;  // or sub-frames
    std::vector<SubPose> views_;

    int stride_ = 0;
    Buffer<float> prepared_store_;
    Prepared prepared_{};
    Buffer<ProjectedSplat> raw_;
    Buffer<Motion> raw_motions_;
    Buffer<float> radius_;  // [splats], largest over the sub-poses
    Buffer<uint32_t> keys_;
    struct Item {
        uint32_t key, splat;
    };
    Buffer<Item> items_, spare_;
    struct PairRun {  // of one run of ranks
        Buffer<int32_t> columns;
        Buffer<uint32_t> tile_counts;  // then where in `entries` the run's next pair of a tile goes
        std::vector<TilePair> pairs;
        uint32_t size;
    };
    std::vector<PairRun> pair_runs_;
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

}  // namespace spiked
