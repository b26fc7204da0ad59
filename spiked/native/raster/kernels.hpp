// The interface between the renderer and the vector kernels. Plain data and pointers only: the kernels are compiled
// once for each instruction set, and a template or inline function shared with the rest of the module could be linked
// from the wrong one.
#pragma once
#include <stdint.h>

namespace raster {

constexpr int kTile = 16;                    // pixels on a side
constexpr int kBlocks = 16;                  // blocks of 4x4 pixels in a tile
constexpr int kTilePixels = kTile * kTile;   // stored block by block, each block row by row
constexpr int kMaxParts = 4;                 // native vectors in a block, at most
constexpr int kGroup = 16;                   // splats are projected in whole groups; a multiple of every vector width
constexpr int kMaxSide = 4096;               // pixels; tile numbers then fit in 16 bits
constexpr int kEmitBatch = 8;                // splats
constexpr uint32_t kCulled = 0xffffffffu;    // as a depth key; as a rank: none
constexpr float kStopTransmittance = 1e-4f;  // a block is finished when none of its pixels lets more through

struct Lens {
    float fx, fy, cx, cy;
    float limit_x, limit_y;  // x/z and y/z beyond these are clamped in the Jacobian
    float near;
    int width, height, tiles_x, tiles_y;
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
struct Record {
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
static_assert(sizeof(Record) == 64, "a record is a cache line");

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
struct Entry {
    uint32_t rank, blocks;
};

struct Pair {
    uint32_t tile_blocks;  // tile << 16 | blocks
    uint32_t rank;
};

struct Pairs {
    Pair* pairs;
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
    const Lens* lens;
    const Record* records;
    const Motion* motions;  // by rank, or null when the camera stands still
    const Entry* entries;
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
struct Passage {
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

enum class Penalty : int { kCharbonnier, kHuber };

struct SsimImage {
    int width, height;
    float c1, c2;
};
// Floats of scratch: eight planes with margins above and below, and eight rows with margins at both ends.
static inline int64_t ssim_scratch(int width, int height) { return 8 * ((int64_t)(height + 10) * width + width + 10); }
constexpr int kMaxChargeFrames = 64;
constexpr int kLeastChargeFrames = 4;  // a pixel that saw the image for less does not count

// Frames of spikes, and an image seen by their pixels at displaced places (charge.inl).
struct ChargeJob {
    int64_t frames, width, height, row_stride, frame_stride;
    int64_t every, phase;  // of so many pairs of rows, the one that is looked at
    bool flipped, msb;
    uint8_t tile[4];  // the colours of a mosaic's 2x2 sites
    const uint8_t* bytes;
    const float* grids;  // [frames][rows][columns][2], px of the sensor, at nodes `cell` apart
    int64_t rows, columns, cell;
    const float* image;  // [colours][image_height][image_width], expected spikes a frame
    int64_t image_width, image_height;
    int32_t colours;
    float pixel;        // side of an image pixel in sensor pixels
    const float* gain;  // [height][width], 0 for pixels that do not count
    const float* dark;  // [height][width] or null, spikes a frame
    float floor;        // error of the map, spikes a frame
    float jitter;       // of an interval's charge
    float* slope;       // [colours][slope_plane], image rows from slope_row on
    int64_t slope_row, slope_plane;
};

struct ChargeSums {
    double loss, pixels, chi2, intervals, expected, counted;
};

constexpr int kMultiplyAddChains = 12;  // vectors that a round of multiply_add changes

struct Kernels {
    const char* name;
    // From the splats to the arrays of Prepared, a whole group at a time; beyond the count the last splat is repeated.
    void (*prepare)(const SplatArrays&, int first, int last, float* const mean[3], float* const spread[9],
                    float* log2_opacity);
    // Writes records[first..last) and keys (bits of z, or kCulled).
    void (*project)(const Prepared&, const Lens&, const View&, int count, int first, int last, Record* records,
                    uint32_t* keys);
    // Writes the pairs of records[first..last) to `out` as long as there is room for kEmitBatch times
    // tiles_x * tiles_y + 4 more, counts them by splat and by tile, and returns the first rank that was left out.
    // `columns` is scratch, 2 * kEmitBatch * (blocks in a column of tiles + kGroup) integers.
    int (*emit)(const Record* records, int first, int last, const Lens&, int32_t* columns, const Pairs& out);
    void (*forward)(const Tile&, int colours, const float background[3], const Planes&, const TileState&, TileImage*);
    void (*store)(const Tile&, const TileImage*, int colours, const Planes&, float* values, float* alpha, float* depth);
    // d_values [height][width] or [height][width][3]; a slot for each entry of slot_floats(colours) floats.
    void (*backward)(const Tile&, int colours, const float* d_values, const Planes&, const TileState&, float* slots);
    // As project, for a camera on its way.
    void (*project_moving)(const Prepared&, const Lens&, const Passage&, int count, int first, int last,
                           Record* records, Motion* motions, uint32_t* keys);
    // Adds one view's gradients of the group [first, first + kGroup); sums [kSums][kGroup] are zero where not visible.
    // pose: 3 of rotation, then 3 of the mean, added up.
    void (*unproject)(const Prepared&, const Lens&, const View&, int first, const float* sums, const uint8_t* visible,
                      int colours, const SplatGradients&, double pose[6]);
    // As unproject, for a camera on its way, by the poses of both ends.
    void (*unproject_moving)(const Prepared&, const Lens&, const Passage&, int first, const float* sums,
                             const uint8_t* visible, int colours, const SplatGradients&, double pose_begin[6],
                             double pose_end[6]);
    // Sums over `count` pixels' windows of their weights in a sub-frame, and of those times the square of the share of
    // the sub-frame that they cover; and the farthest time from its middle.
    void (*cover)(const Planes&, int64_t count, double* weight, double* square, float* time_reach);
    // From the gradients of spread, log opacity and so on to those of the parameters, for splats [first, last); zeros
    // where out.radius_px is 0. share_scale multiplies the contributions.
    void (*finish)(const SplatArrays&, const Prepared&, const SplatGradients&, int first, int last, float share_scale,
                   const GradientArrays& out);
    // One step over [rows][columns <= 4]; correction is the bias correction of a row, 0 to leave it as it is.
    void (*adam)(const AdamRates&, int rows, int columns, const float* correction, const float* gradient,
                 float* parameter, float* first, float* second);
    // sum of weight * penalty(rendered - target), and its gradient.
    double (*robust)(Penalty, float scale, int64_t count, const float* rendered, const float* target,
                     const float* weight, float* d_rendered);
    // Mean structural similarity of two planes, and its gradient.
    double (*ssim)(const SsimImage&, const float* rendered, const float* target, float* scratch, float* d_rendered);
    // Adds rows [first, last) to the sums and to job.slope; lines [frames][columns][2] and scratch are its own.
    void (*charge)(const ChargeJob&, int64_t first, int64_t last, float* lines, void* scratch, ChargeSums&);
    int64_t (*charge_scratch)();
    float (*multiply_add)(int64_t rounds);
    int lanes;
};

extern const Kernels kBaseline;
#if defined(__x86_64__)
extern const Kernels kAvx2;
extern const Kernels kAvx512;
#elif defined(__aarch64__)
extern const Kernels kNeon;
#endif

const Kernels& choose_kernels();  // throws std::invalid_argument for an unknown or unsupported SPIKED_SIMD

}  // namespace raster
