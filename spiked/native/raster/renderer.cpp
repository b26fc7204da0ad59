#include "renderer.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

namespace spiked {

namespace {

constexpr int kChunk = 1024;  // splats a task; fixed, so that sums do not depend on the number of threads

constexpr int kAhead = 16;  // splats; covers the latency of main memory

int chunks_of(int count) { return (count + kChunk - 1) / kChunk; }

}  // namespace

Renderer::Renderer(const PinholeF& camera, int threads)
    : kernels_(choose_kernels()), camera_(camera), pool_(threads), pair_runs_(threads), scratch_(threads) {}

void Renderer::forward(const SplatArrays& splats, const Views& views, const float background[3], float* values,
                       float* alpha, float* depth) {
    splats_ = splats;
    planes_ = views;
    sub_poses_ = moving() ? views.count - 1 : views.count;
    if (static_cast<int>(views_.size()) < views.count) views_.resize(views.count);
    for (int i = 0; i < views.count; ++i) views_[i].view = view_of(views.rotations + 9 * i, views.centres + 3 * i);
    if (moving()) set_sub_frames();
    prepare();
    std::fill_n(radius_.grow(splats.count), splats.count, 0.0f);
    for (int i = 0; i < sub_poses_; ++i) {
        SubPose& sub = views_[i];
        project(sub);
        sort(sub);
        bin(sub);
        const size_t tiles = static_cast<size_t>(camera_.tiles_x) * camera_.tiles_y;
        sub.colour.grow(tiles * splats.colours * kTilePixels);
        sub.ends.grow(tiles * kBlocks * kMaxParts);
    }
    pool_.run(camera_.tiles_x * camera_.tiles_y, [&](int tile, int thread) {
        TileImage* image = scratch_[thread].image.grow(1);
        std::memset(static_cast<void*>(image), 0, sizeof *image);
        for (int i = 0; i < sub_poses_; ++i)
            kernels_.forward(tile_of(views_[i], tile, thread), splats.colours, background, planes_of(i),
                             state_of(views_[i], tile), image);
        kernels_.store_tile(tile_of(views_[0], tile, thread), image, splats.colours, planes_of(0), values, alpha,
                            depth);
    });
}

void Renderer::set_sub_frames() {
    pool_.run(sub_poses_, [&](int i, int) {
        double weight, square;
        SubFrame& sub_frame = views_[i].sub_frame;
        kernels_.cover(planes_of(i), static_cast<int64_t>(camera_.width) * camera_.height, &weight, &square,
                       &sub_frame.time_reach);
        sub_frame.begin = views_[i].view;
        sub_frame.end = views_[i + 1].view;
        // The variance of an even motion is a twelfth of its square.
        sub_frame.blur = weight > 0 ? static_cast<float>(square / weight / 12) : 0.0f;
    });
}

void Renderer::prepare() {
    stride_ = (splats_.count + kGroup - 1) / kGroup * kGroup;
    float* at = prepared_store_.grow(static_cast<size_t>(stride_) * 13);
    float *mean[3], *spread[9], *log2_opacity;
    for (int k = 0; k < 3; ++k, at += stride_) prepared_.mean[k] = mean[k] = at;
    for (int k = 0; k < 9; ++k, at += stride_) prepared_.spread[k] = spread[k] = at;
    prepared_.log2_opacity = log2_opacity = at;
    pool_.run(chunks_of(stride_), [&](int chunk, int) {
        kernels_.prepare(splats_, chunk * kChunk, std::min(stride_, (chunk + 1) * kChunk), mean, spread, log2_opacity);
    });
}

void Renderer::project(SubPose& sub) {
    raw_.grow(stride_);
    if (moving()) raw_motions_.grow(stride_);
    keys_.grow(stride_);
    pool_.run(chunks_of(stride_), [&](int chunk, int) {
        const int first = chunk * kChunk, last = std::min(stride_, first + kChunk);
        if (moving()) {
            kernels_.project_moving(prepared_, camera_, sub.sub_frame, splats_.count, first, last, raw_.data(),
                                    raw_motions_.data(), keys_.data());
        } else {
            kernels_.project(prepared_, camera_, sub.view, splats_.count, first, last, raw_.data(), keys_.data());
        }
        for (int n = first; n < std::min(last, splats_.count); ++n)
            if (keys_[n] != kCulled) radius_[n] = std::max(radius_[n], raw_[n].radius);
    });
}

// Visible splats by depth, equal depths by number: a radix sort of the bits of z, which order like z for z > 0.
void Renderer::sort(SubPose& sub) {
    constexpr int kBits = 11, kDigits = 3, kBins = 1 << kBits;
    Item *from = items_.grow(splats_.count), *to = spare_.grow(splats_.count);
    uint32_t histogram[kDigits][kBins] = {};
    int visible = 0;
    for (int i = 0; i < splats_.count; ++i) {
        const uint32_t key = keys_[i];
        if (key == kCulled) continue;
        from[visible++] = {key, static_cast<uint32_t>(i)};
        for (int digit = 0; digit < kDigits; ++digit) ++histogram[digit][key >> (kBits * digit) & (kBins - 1)];
    }
    for (int digit = 0; digit < kDigits; ++digit) {
        uint32_t sum = 0;
        for (uint32_t& bin : histogram[digit]) sum += std::exchange(bin, sum);
        for (int i = 0; i < visible; ++i)
            to[histogram[digit][from[i].key >> (kBits * digit) & (kBins - 1)]++] = from[i];
        std::swap(from, to);
    }
    sub.visible = visible;
    sub.records.grow(visible);
    if (moving()) sub.motions.grow(visible);
    pool_.run(chunks_of(visible), [&](int chunk, int) {
        const int last = std::min(visible, (chunk + 1) * kChunk);
        for (int rank = chunk * kChunk; rank < last; ++rank) {
            if (rank + kAhead < last) __builtin_prefetch(&raw_[from[rank + kAhead].splat]);
            const uint32_t splat = from[rank].splat;
            ProjectedSplat& record = sub.records[rank] = raw_[splat];
            for (int k = 0; k < splats_.colours; ++k) record.colour[k] = splats_.colour[splats_.colours * splat + k];
            record.splat = splat;
            if (moving()) sub.motions[rank] = raw_motions_[splat];
        }
    });
}

// Lists the splats of every tile in order of depth: pairs are written splat by splat, then sorted by tile by counting.
void Renderer::bin(SubPose& sub) {
    const int tiles = camera_.tiles_x * camera_.tiles_y, runs = pool_.threads();
    const size_t rows = static_cast<size_t>(camera_.tiles_y) * 4 + kGroup;
    uint32_t* counts = sub.first_pair.grow(splats_.count + 1);
    std::fill_n(counts, splats_.count, 0u);
    auto first_rank = [&](int run) { return static_cast<int>(static_cast<int64_t>(sub.visible) * run / runs); };
    pool_.run(runs, [&](int run, int) {
        PairRun& run_pairs = pair_runs_[run];
        int32_t* columns = run_pairs.columns.grow(2 * kSplatBatch * rows);
        uint32_t* tile_counts = run_pairs.tile_counts.grow(tiles);
        std::fill_n(tile_counts, tiles, 0u);
        run_pairs.size = 0;
        int rank = first_rank(run);
        for (const int last = first_rank(run + 1); rank < last;) {
            const size_t room = run_pairs.size + kSplatBatch * (static_cast<size_t>(tiles) + 4);
            if (run_pairs.pairs.size() < room) run_pairs.pairs.resize(2 * room);
            const TilePairList out{run_pairs.pairs.data(), static_cast<uint32_t>(run_pairs.pairs.size()),
                                   &run_pairs.size, counts, tile_counts};
            rank = kernels_.intersect_tiles(sub.records.data(), rank, last, camera_, columns, out);
        }
    });

    uint32_t sum = 0;
    for (int n = 0; n < splats_.count; ++n) sum += std::exchange(counts[n], sum);
    counts[splats_.count] = sum;
    sub.pairs = sum;
    uint32_t* tile_start = sub.tile_start.grow(tiles + 1);
    sum = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        tile_start[tile] = sum;
        for (int run = 0; run < runs; ++run) sum += std::exchange(pair_runs_[run].tile_counts[tile], sum);
    }
    tile_start[tiles] = sum;

    TileEntry* entries = sub.entries.grow(sum);
    uint32_t* places = sub.places.grow(static_cast<size_t>(sum) + kAhead);
    std::fill_n(places + sum, kAhead, 0u);
    pool_.run(runs, [&](int run, int) {
        PairRun& run_pairs = pair_runs_[run];
        uint32_t slot = 0, rank = kCulled;
        for (uint32_t i = 0; i < run_pairs.size; ++i, ++slot) {
            const TilePair pair = run_pairs.pairs[i];
            if (pair.rank != rank) {
                rank = pair.rank;
                slot = sub.first_pair[sub.records[rank].splat];
            }
            const uint32_t place = run_pairs.tile_counts[pair.tile_blocks >> 16]++;
            entries[place] = {rank, pair.tile_blocks & 0xffffu};
            places[slot] = place;
        }
    });
}

Tile Renderer::tile_of(const SubPose& sub, int tile, int thread) {
    const uint32_t start = sub.tile_start[tile];
    const int count = static_cast<int>(sub.tile_start[tile + 1] - start);
    return {&camera_,
            sub.records.data(),
            moving() ? sub.motions.data() : nullptr,
            sub.entries.data() + start,
            count,
            tile % camera_.tiles_x,
            tile / camera_.tiles_x,
            scratch_[thread].local.grow(static_cast<size_t>(count) * 16),
            scratch_[thread].listed.grow(static_cast<size_t>(count) + kGroup),
            scratch_[thread].blocks.grow(static_cast<size_t>(count) + kGroup)};
}

TileState Renderer::state_of(const SubPose& sub, int tile) const {
    return {sub.colour.data() + static_cast<size_t>(tile) * splats_.colours * kTilePixels,
            sub.ends.data() + static_cast<size_t>(tile) * kBlocks * kMaxParts};
}

Planes Renderer::planes_of(int sub_pose) const {
    const size_t plane = static_cast<size_t>(camera_.width) * camera_.height;
    return {planes_.weights ? planes_.weights + sub_pose * plane : nullptr,
            1.0f / static_cast<float>(sub_poses_),
            planes_.channels,
            planes_.start,
            planes_.stop,
            static_cast<float>(sub_pose)};
}

void Renderer::backward(const float* d_values, const GradientArrays& out) {
    for (int i = 0; i < sub_poses_; ++i) views_[i].slots.grow(static_cast<size_t>(views_[i].pairs) * slot_floats());
    pool_.run(camera_.tiles_x * camera_.tiles_y, [&](int tile, int thread) {
        for (int i = 0; i < sub_poses_; ++i)
            kernels_.backward(tile_of(views_[i], tile, thread), splats_.colours, d_values, planes_of(i),
                              state_of(views_[i], tile),
                              views_[i].slots.data() + static_cast<size_t>(views_[i].tile_start[tile]) * slot_floats());
    });

    const int chunks = chunks_of(stride_);
    const size_t pose_doubles = static_cast<size_t>(poses()) * 6;
    std::fill_n(poses_.grow(chunks * pose_doubles), chunks * pose_doubles, 0.0);
    pool_.run(chunks, [&](int chunk, int thread) {
        const int first = chunk * kChunk, last = std::min(stride_, first + kChunk);
        float* store = scratch_[thread].gradients.grow(17 * kChunk);
        std::fill_n(store, 17 * kChunk, 0.0f);
        SplatGradients sums;
        sums.first = first;
        for (float*& p : sums.mean) p = store, store += kChunk;
        for (float*& p : sums.spread) p = store, store += kChunk;
        for (float*& p : sums.colour) p = store, store += kChunk;
        sums.log_opacity = store;
        sums.share = store + kChunk;
        alignas(64) float group[kSums * kGroup];
        uint8_t visible[kGroup];
        for (int i = 0; i < sub_poses_; ++i) {
            double* pose = poses_.data() + chunk * pose_doubles + 6 * i;
            for (int at = first; at < last; at += kGroup) {
                gather(views_[i], at, group, visible);
                if (std::none_of(visible, visible + kGroup, [](uint8_t v) { return v != 0; })) continue;
                if (moving()) {
                    kernels_.unproject_moving(prepared_, camera_, views_[i].sub_frame, at, group, visible,
                                              splats_.colours, sums, pose, pose + 6);
                } else {
                    kernels_.unproject(prepared_, camera_, views_[i].view, at, group, visible, splats_.colours, sums,
                                       pose);
                }
            }
        }
        const int end = std::min(last, splats_.count);
        std::copy(radius_.data() + first, radius_.data() + end, out.radius_px + first);
        kernels_.finish(splats_, prepared_, sums, first, end, 1.0f / static_cast<float>(sub_poses_), out);
    });

    for (int i = 0; i < poses(); ++i) {
        double sum[6] = {};
        for (int chunk = 0; chunk < chunks; ++chunk)
            for (int k = 0; k < 6; ++k) sum[k] += poses_[chunk * pose_doubles + 6 * i + k];
        for (int k = 0; k < 3; ++k) {
            out.rotation[3 * i + k] = sum[k];
            out.centre[3 * i + k] = -sum[3 + k];
        }
    }
}

// The sums of a group's splats over their tiles.
void Renderer::gather(const SubPose& sub, int first, float* sums, uint8_t* visible) const {
    const int stride = slot_floats(), used = moving() ? kSums : kColour0 + splats_.colours;
    const float* slots = sub.slots.data();
    for (int lane = 0; lane < kGroup; ++lane) {
        const int splat = std::min(first + lane, splats_.count);
        const uint32_t from = sub.first_pair[splat];
        const uint32_t to = splat < splats_.count ? sub.first_pair[splat + 1] : from;
        visible[lane] = to > from;
        float sum[16] = {};
        for (uint32_t n = from; n < to; ++n) {
            __builtin_prefetch(slots + static_cast<size_t>(sub.places[n + kAhead]) * stride);
            const float* slot = slots + static_cast<size_t>(sub.places[n]) * stride;
            for (int k = 0; k < used; ++k) sum[k] += slot[k];
        }
        for (int k = 0; k < used; ++k) sums[k * kGroup + lane] = sum[k];
    }
}

int64_t Renderer::block_evaluations() const {
    int64_t sum = 0;
    for (int i = 0; i < sub_poses_; ++i)
        for (uint32_t n = 0; n < views_[i].pairs; ++n) sum += __builtin_popcount(views_[i].entries[n].blocks);
    return sum;
}

}  // namespace spiked
