// The interface between the renderer and the vector kernels: plain data and pointers only, see instruction_sets.hpp.
#pragma once
#include <stdint.h>

#include "../common/instruction_sets.hpp"

namespace spiked {

constexpr int kTile = 16;                    // pixels on a side
constexpr int kBlocks = 16;                  // blocks of 4x4 pixels in a tile
constexpr int kTilePixels = kTile * kTile;   // stored block by block, each block row by row
constexpr int kMaxParts = 4;                 // native vectors in a block, at most
constexpr int kGroup = 16;                   // splats are projected in whole groups; a multiple of every vector width
constexpr int kMaxSide = 4096;               // pixels; tile numbers then fit in 16 bits
constexpr int kSplatBatch = 8;               // splats
constexpr uint32_t kCulled = 0xffffffffu;    // as a depth key; as a rank: none
constexpr float kStopTransmittance = 1e-4f;  // a block is finished when none of its pixels lets more through

struct PinholeF {
    float fx, fy, cx, cy;
    float limit_x, limit_y;  // x/z and y/z beyond these are clamped in the Jacobian
    float near;
    int width, height, tiles_x, tiles_y;
    // Distortion, see spiked/distortion.py: 0 none, 1 OpenCV's polynomial, 2 fisheye.
    int lens;
    float coefficients[5];
    float reach2;  // square of the largest slope that is drawn
};

// World to camera: p = rotation (mean - centre); the centre is split in two floats to keep the precision of a double.
struct View {
    float rotation[9];
    float centre_high[3], centre_low[3];
};

// What does not depend on the view, as arrays of `stride` floats (a multiple of kGroup).
struct Prepared {
    const float* mean[3];
    const float* spread[9];     // rotation of the splat times diag(scales), row-major
    const float* log2_opacity;  // log2(sigmoid(logit))
};

// A projected splat. With d the offset from its mean (px), u = p dx + q dy and w = r dy,
// log2(alpha) = log2_opacity - u^2 - w^2: the Cholesky factor of the conic, scaled so that no constant is left over.
struct ProjectedSplat {
    float x, y;
    float p, q, r;
    float log2_opacity;
    float z;
    float radius;          // px, largest half axis of the ellipse where alpha reaches 1/255
    float half_x, half_y;  // px, of that ellipse's box
    float extreme;         // px, where its rightmost point is above or below the mean; the leftmost is opposite
    float over_p;
    float colour[3];
    uint32_t splat;
};
constexpr int kRecordFields = 12;  // the first ones, which come from the projection
static_assert(sizeof(ProjectedSplat) == 64, "a record is a cache line");

// What a splat that crosses the image during a sub-frame adds to its record, whose ellipse then holds all of its path.
// p, q, r and the opacity are those of the splat blurred by its motion; at time t in [-1/2, 1/2] from the middle of the
// sub-frame, u and w are smaller by u_rate t and w_rate t.
struct Motion {
    float p, q, r;
    float log2_opacity;
    float u_rate, w_rate;
    float unused[2];
};

// A splat seen by a tile.
struct TileEntry {
    uint32_t rank, blocks;
};

struct TilePair {
    uint32_t tile_blocks;  // tile << 16 | blocks
    uint32_t rank;
};

struct TilePairList {
    TilePair* pairs;
    uint32_t room;
    uint32_t* size;         // pairs written so far
    uint32_t* counts;       // [splats]
    uint32_t* tile_counts;  // [tiles]
};

// Sums over a tile's pixels for one pair; v = alpha dL/dalpha, and alpha T is the pixel's share of the splat.
// t is the pixel's time in the sub-frame.
enum Sum { kV, kVu, kVw, kVuu, kVuw, kVww, kShare, kColour0, kColour1, kColour2, kVut, kVwt, kSums };
static constexpr int slot_floats(int colours, bool moving) { return colours == 1 && !moving ? 8 : 16; }

struct Tile {
    const PinholeF* camera;
    const ProjectedSplat* records;
    const Motion* motions;  // by rank, or null when the camera stands still
    const TileEntry* entries;
    int count;
    int tile_x, tile_y;
    float* local;      // scratch, 16 floats an entry
    uint32_t* listed;  // scratch, an integer an entry and kGroup more
    uint16_t* blocks;  // scratch, likewise
};

// Of one tile of one sub-pose, kept for the backward pass. Pixels in tile order.
struct TileState {
    float* colour;  // [colours][kTilePixels], background included
    int32_t* ends;  // [kBlocks * kMaxParts] entries composited before that part of the block was full
};

struct Planes {
    const float* weight;  // [height][width], or null for `uniform_weight`
    float uniform_weight;
    const uint8_t* channels;  // [height][width], or null when a pixel sees every colour
    // While the camera moves, [height][width], the times when a pixel's window begins and ends: its weight is the share
    // of its window that lies in the sub-frame [sub_frame, sub_frame + 1].
    const float *start, *stop;
    float sub_frame;
};

// The two poses between which the camera moves during a sub-frame.
struct SubFrame {
    View begin, end;
    float blur;        // how much of the square of its motion is added to a splat's covariance
    float time_reach;  // times of pixels are within this of the middle
};

// Sums over sub-poses; written back to images when the tile is done.
struct TileImage {
    float value[3][kTilePixels];
    float weight[kTilePixels], alpha[kTilePixels], depth[kTilePixels];
};

struct SplatArrays {  // C-contiguous: [count][3], [count][4], [count][3], [count], [count][colours]
    int count, colours;
    const float *means, *quats, *log_scales, *opacity_logits, *colour;
};

// What the axes along which means are moved are made of: [count][4], [count][3].
struct SplatAxes {
    const float *quats, *log_scales;
    float blur;  // a length, as the means
    bool own;    // whether these are the axes of the splats; otherwise those of the world
};

struct GradientArrays {  // the same shapes; rotation and centre [sub-poses][3]
    float *means, *quats, *log_scales, *opacity_logits, *colour;
    double *rotation, *centre;
    float *contribution, *radius_px;
};

struct SplatGradients {  // arrays of some groups of splats, from `first` on; summed over sub-poses
    int first;
    float* mean[3];
    float* spread[9];
    float* log_opacity;
    float* colour[3];
    float* share;
};

struct AdamRates {
    float rate, blend1, blend2, epsilon;  // blend: 1 - beta
};

struct SsimImage {
    int width, height;
    float c1, c2;
};
constexpr int kSsimMargin = 5;  // rows
// Floats of scratch of a thread: eight rows with margins at both ends, and five without.
static inline int64_t ssim_scratch(int width) { return 8 * ((int64_t)width + 2 * kSsimMargin) + 5 * (int64_t)width; }

struct RasterKernels {
    const char* name;
#define SPIKED_KERNEL(result, name, arguments) result(*name) arguments;
#include "kernel_list.inl"
#undef SPIKED_KERNEL
};
SPIKED_DECLARE_KERNEL_TABLES(RasterKernels, raster_kernels)

const RasterKernels& choose_kernels();  // throws std::invalid_argument for an unknown or unsupported SPIKED_SIMD

}  // namespace spiked
