// The kernels of the rasteriser on a GPU, see block.hpp. Projection and its gradients are those of the CPU, a splat a
// thread; compositing has a pixel a thread.

namespace spiked {
namespace {

constexpr float kAlphaCap = 0.99f;  // as on the CPU
constexpr int kBatch = 256;         // entries that a tile loads at a time, forward
constexpr int kBackwardBatch = 32;  // backward
constexpr int kSplatThreads = 128;  // of kernels with a splat a thread

// Pixel of a tile that a thread has: a warp has 8 x 4 of them.
struct TilePixel {
    int x, y;
};
SPIKED_DEVICE inline TilePixel tile_pixel(int thread) {
    const int warp = thread / kWarp, lane = thread % kWarp;
    return {warp % 2 * 8 + lane % 8, warp / 2 * 4 + lane / 8};
}

// Poses to project by: views of a camera that stands still, or sub-frames of one that moves.
struct Poses {
    const View* views;
    SubFrame* sub_frames;
    int sub_poses;
};

// A splat seen by a tile, as compositing reads it: u = p x + q y + s and w = r y + t at a pixel (x, y) of the tile.
struct Entry {
    float p, q, s, r, t, log2_opacity, z, u_rate, w_rate, colour[3];
};

// Of an entry at a pixel, with its u and w there.
template <bool Moving>
SPIKED_DEVICE inline float log2_alpha_at(const Entry& s, float x, float y, float time, float& u, float& w) {
    u = s.p * x + (s.q * y + s.s), w = s.r * y + s.t;
    if constexpr (Moving) {
        u -= s.u_rate * time;
        w -= s.w_rate * time;
    }
    return (s.log2_opacity - u * u) - w * w;
}

struct Scene {
    PinholeF camera;
    Prepared prepared;
    SplatArrays splats;
    Poses poses;
};

constexpr uint32_t kNoRow = 0xffffffffu;

// Rows of an array in another order; zeros for kNoRow.
template <class T>
struct TakeRows {
    static constexpr int kThreads = 256;
    const T* in;
    T* out;
    const uint32_t* rows;
    uint64_t count;  // of elements
    int columns;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const uint64_t at = static_cast<uint64_t>(block.index) * kThreads + thread;
            if (at >= count) return;
            const uint32_t row = rows[at / columns];
            out[at] = row == kNoRow ? T{} : in[static_cast<uint64_t>(row) * columns + at % columns];
        });
    }
};

// From splats to Prepared.
struct Prepare {
    static constexpr int kThreads = kSplatThreads;
    SplatArrays splats;
    float *mean[3], *spread[9], *log2_opacity;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int n = static_cast<int>(block.index) * kThreads + thread;
            if (n < splats.count) prepare(splats, n, n + 1, mean, spread, log2_opacity);
        });
    }
};

// The sub-frames of a moving camera: a block each. `cover` of the CPU.
struct SetSubFrames {
    static constexpr int kThreads = 1024;
    Poses poses;
    const float *start, *stop;
    int64_t pixels;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        SPIKED_SHARED double totals[kThreads / kWarp][2];
        SPIKED_SHARED float farthest[kThreads];
        PerThread<Sums<double, 2>, kThreads> sums;
        PerThread<bool, kThreads> some;
        const Planes planes{nullptr, 0, nullptr, start, stop, static_cast<float>(block.index)};
        block.each([&](int thread) {
            double weight = 0, square = 0;
            float reach = 0;
            for (int64_t at = thread; at < pixels; at += kThreads) {
                const Covered part = covered_by(planes, at);
                weight += part.weight;
                square += part.weight * part.length * part.length;
                reach = fmaxf(reach, part.weight > 0 ? fabsf(part.time) : 0);
            }
            sums[thread] = {{weight, square}};
            some[thread] = true;
            farthest[thread] = reach;
        });
        block.warp_sums(sums, some, &totals[0][0], 2);
        block.sync();
        block.each([&](int thread) {
            if (thread > 0) return;
            double weight = 0, square = 0;
            float reach = 0;
            for (int i = 0; i < kThreads / kWarp; ++i) weight += totals[i][0], square += totals[i][1];
            for (int i = 0; i < kThreads; ++i) reach = fmaxf(reach, farthest[i]);
            SubFrame& out = poses.sub_frames[block.index];
            out.begin = poses.views[block.index];
            out.end = poses.views[block.index + 1];
            out.blur = weight > 0 ? static_cast<float>(square / weight / 12) : 0.0f;
            out.time_reach = reach;
        });
    }
};

// A splat and a sub-pose a thread: its record and the key of its depth.
template <bool Bent, bool Moving>
struct Project {
    static constexpr int kThreads = kSplatThreads;
    Scene scene;
    ProjectedSplat* records;  // [sub-poses][splats]
    Motion* motions;
    uint32_t *keys, *order;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t at = static_cast<int64_t>(block.index) * kThreads + thread;
            const int count = scene.splats.count;
            if (at >= static_cast<int64_t>(count) * scene.poses.sub_poses) return;
            const int sub_pose = static_cast<int>(at / count), n = static_cast<int>(at % count);
            const int64_t first = at - n;
            if constexpr (Moving) {
                project_moving_by<Bent>(scene.prepared, scene.camera, scene.poses.sub_frames[sub_pose], count, n, n + 1,
                                        records + first, motions + first, keys + first);
            } else {
                project_by<Bent>(scene.prepared, scene.camera, scene.poses.views[sub_pose], count, n, n + 1,
                                 records + first, keys + first);
            }
            order[at] = static_cast<uint32_t>(at);
            if (keys[at] == kCulled) return;
            for (int k = 0; k < scene.splats.colours; ++k)
                records[at].colour[k] = scene.splats.colour[static_cast<int64_t>(scene.splats.colours) * n + k];
            records[at].splat = static_cast<uint32_t>(n);
        });
    }
};

// visit(tile) for the tiles that a splat reaches, row by row.
template <class Visit>
SPIKED_DEVICE inline void each_tile(const ProjectedSplat& s, const PinholeF& camera, Visit visit) {
    const float half_y = s.half_y + kMargin;
    const float top = s.y - s.half_y - (0.5f + kMargin), bottom = s.y + s.half_y - (0.5f - kMargin);
    if (bottom < 0 || top > camera.height - 1) return;
    const int from = top <= 0 ? 0 : static_cast<int>(top) / kTile;
    const int to = static_cast<int>(fminf(bottom, camera.height - 1.0f)) / kTile;
    for (int row = from; row <= to; ++row) {
        const float low = fmaxf(kTile * row + 0.5f - s.y, -half_y);
        const float high = fminf(kTile * row + (kTile - 0.5f) - s.y, half_y);
        if (!(low <= high)) continue;
        Vec left, right;
        extent_in_rows(s, low, high, left, right);
        const float last = s.x + right.v * s.over_p - (0.5f - kMargin);
        const float first = s.x + left.v * s.over_p - (0.5f + kMargin);
        if (last < 0 || first > camera.width - 1) continue;
        const int a = first <= 0 ? 0 : static_cast<int>(ceilf(first)) / kTile;
        const int b = static_cast<int>(fminf(last, camera.width - 1.0f)) / kTile;
        for (int column = a; column <= b; ++column) visit(row * camera.tiles_x + column);
    }
}

// How many tiles each splat reaches; a splat a thread, by depth.
struct CountTiles {
    static constexpr int kThreads = kSplatThreads;
    PinholeF camera;
    const ProjectedSplat* records;
    const uint32_t *keys, *order;  // sorted
    uint32_t count;
    uint64_t* tiles;  // [count + 1]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const uint32_t rank = block.index * kThreads + thread;
            if (rank > count) return;
            uint64_t reached = 0;
            if (rank < count && keys[rank] != kCulled) each_tile(records[order[rank]], camera, [&](int) { ++reached; });
            tiles[rank] = reached;
        });
    }
};

// The pairs of splats and tiles, by depth.
struct ListPairs {
    static constexpr int kThreads = kSplatThreads;
    PinholeF camera;
    const ProjectedSplat* records;
    const uint32_t* order;
    const uint64_t* first;  // [count + 1], by rank
    uint32_t count, splats;
    uint32_t *pair_tiles, *pairs;  // keys and values of the next sort
    uint32_t* pair_record;         // [pairs]
    uint32_t* first_of_record;     // [sub-poses][splats], and
    uint32_t* pairs_of_record;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const uint32_t rank = block.index * kThreads + thread;
            if (rank >= count) return;
            const uint32_t record = order[rank], begin = static_cast<uint32_t>(first[rank]);
            const uint32_t end = static_cast<uint32_t>(first[rank + 1]);
            first_of_record[record] = begin;
            pairs_of_record[record] = end - begin;
            if (begin == end) return;
            const uint32_t tile0 = record / splats * static_cast<uint32_t>(camera.tiles_x * camera.tiles_y);
            uint32_t at = begin;
            each_tile(records[record], camera, [&](int tile) {
                pair_tiles[at] = tile0 + tile;
                pairs[at] = at;
                pair_record[at] = record;
                ++at;
            });
        });
    }
};

// Where each tile's pairs begin, after they are sorted by tile.
struct FindTiles {
    static constexpr int kThreads = 256;
    const uint32_t* pair_tiles;
    uint32_t pairs, tiles;
    uint32_t* start;  // [tiles + 1]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const uint32_t i = block.index * kThreads + thread;
            if (i > pairs) return;
            const uint32_t before = i > 0 ? pair_tiles[i - 1] + 1 : 0, here = i < pairs ? pair_tiles[i] : tiles;
            for (uint32_t tile = before; tile <= here; ++tile) start[tile] = i;
        });
    }
};

// What compositing reads of a tile of a sub-pose. A block has the tile `index % tiles` of the sub-pose `index / tiles`.
struct Tiles {
    PinholeF camera;
    const ProjectedSplat* records;
    const Motion* motions;
    const uint32_t *start, *pairs, *pair_record;
    const float *weights, *begin, *end;  // planes, see Views
    const uint8_t* channels;
    int sub_poses;

    SPIKED_DEVICE int tiles() const { return camera.tiles_x * camera.tiles_y; }

    template <bool Moving>
    SPIKED_DEVICE Entry entry(uint32_t pair, float left, float top, int colours) const {
        const uint32_t at = pair_record[pair];
        const ProjectedSplat& in = records[at];
        Entry out;
        if constexpr (Moving) {
            const Motion& motion = motions[at];
            out.p = motion.p, out.q = motion.q, out.r = motion.r, out.log2_opacity = motion.log2_opacity;
            out.u_rate = motion.u_rate, out.w_rate = motion.w_rate;
        } else {
            out.p = in.p, out.q = in.q, out.r = in.r, out.log2_opacity = in.log2_opacity;
        }
        out.s = -(out.p * (in.x - left) + out.q * (in.y - top));
        out.t = -out.r * (in.y - top);
        out.z = in.z;
        for (int k = 0; k < colours; ++k) out.colour[k] = in.colour[k];
        return out;
    }

    // Weight of a pixel in a sub-pose, and its time in it.
    template <bool Moving>
    SPIKED_DEVICE void exposure(int sub_pose, int64_t pixel, float& weight, float& time) const {
        if constexpr (Moving) {
            const Planes planes{nullptr, 0, nullptr, begin, end, static_cast<float>(sub_pose)};
            const Covered part = covered_by(planes, pixel);
            weight = part.weight, time = part.time;
        } else {
            const int64_t plane = static_cast<int64_t>(camera.width) * camera.height;
            weight = weights ? weights[sub_pose * plane + pixel] : 1.0f / sub_poses, time = 0;
        }
    }
};

// Of each pixel of a tile of a sub-pose, [sub-poses][tiles][kTilePixels] in order of threads.
struct States {
    float* colour[3];  // background included
    float *transmittance, *depth;
    uint32_t* end;  // entries that were composited
};

template <int C, bool Moving>
struct Forward {
    static constexpr int kThreads = kTilePixels;
    Tiles tiles;
    States states;
    float background[3];
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        struct Pixel {
            float x, y, time, t, depth, colour[C];
            uint32_t end;
            bool open;
        };
        SPIKED_SHARED Entry entries[kBatch];
        PerThread<Pixel, kThreads> pixels;
        const int tile = static_cast<int>(block.index) % tiles.tiles(),
                  sub_pose = static_cast<int>(block.index) / tiles.tiles();
        const int left = tile % tiles.camera.tiles_x * kTile, top = tile / tiles.camera.tiles_x * kTile;
        const uint32_t first = tiles.start[block.index], last = tiles.start[block.index + 1];
        block.each([&](int thread) {
            const TilePixel at = tile_pixel(thread);
            Pixel& pixel = pixels[thread];
            pixel = {at.x + 0.5f, at.y + 0.5f, 0, 0, 0, {}, 0, false};
            if (left + at.x >= tiles.camera.width || top + at.y >= tiles.camera.height) return;
            float weight;
            tiles.exposure<Moving>(sub_pose, static_cast<int64_t>(top + at.y) * tiles.camera.width + left + at.x,
                                   weight, pixel.time);
            pixel.t = 1;
            pixel.open = weight > 0;
        });
        for (uint32_t from = first; from < last; from += kBatch) {
            if (!block.any([&](int thread) { return pixels[thread].open; })) break;
            const int count = static_cast<int>(last - from < kBatch ? last - from : kBatch);
            block.each([&](int thread) {
                if (thread < count)
                    entries[thread] = tiles.entry<Moving>(tiles.pairs[from + thread], static_cast<float>(left),
                                                          static_cast<float>(top), C);
            });
            block.sync();
            block.each([&](int thread) {
                Pixel& pixel = pixels[thread];
                if (!pixel.open) return;
                for (int i = 0; i < count; ++i) {
                    const Entry& s = entries[i];
                    float u, w;
                    const float log2_alpha = log2_alpha_at<Moving>(s, pixel.x, pixel.y, pixel.time, u, w);
                    if (!(log2_alpha >= -kLog2Cut)) continue;
                    const float share = fminf(exp2f(log2_alpha), kAlphaCap) * pixel.t;
                    pixel.t -= share;
                    pixel.depth += share * s.z;
                    for (int k = 0; k < C; ++k) pixel.colour[k] += share * s.colour[k];
                    pixel.end = from - first + i + 1;
                    if (pixel.t < kStopTransmittance) {
                        pixel.open = false;
                        break;
                    }
                }
            });
            block.sync();
        }
        block.each([&](int thread) {
            const Pixel& pixel = pixels[thread];
            const int64_t at = static_cast<int64_t>(block.index) * kTilePixels + thread;
            states.transmittance[at] = pixel.t;
            states.depth[at] = pixel.depth;
            states.end[at] = pixel.end;
            for (int k = 0; k < C; ++k) states.colour[k][at] = pixel.colour[k] + background[k] * pixel.t;
        });
    }
};

// The image: sums over the sub-poses. A block has a tile.
template <int C, bool Moving>
struct Combine {
    static constexpr int kThreads = kTilePixels;
    Tiles tiles;
    States states;
    float *values, *alpha, *depth;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        const int tile = static_cast<int>(block.index);
        const int left = tile % tiles.camera.tiles_x * kTile, top = tile / tiles.camera.tiles_x * kTile;
        block.each([&](int thread) {
            const TilePixel place = tile_pixel(thread);
            const int x = left + place.x, y = top + place.y;
            if (x >= tiles.camera.width || y >= tiles.camera.height) return;
            const int64_t pixel = static_cast<int64_t>(y) * tiles.camera.width + x;
            float total = 0, opaque = 0, distance = 0, value[3] = {};
            for (int sub_pose = 0; sub_pose < tiles.sub_poses; ++sub_pose) {
                float weight, time;
                tiles.exposure<Moving>(sub_pose, pixel, weight, time);
                const int64_t at = (static_cast<int64_t>(sub_pose) * tiles.tiles() + tile) * kTilePixels + thread;
                total += weight;
                opaque += weight * (1.0f - states.transmittance[at]);
                distance += weight * states.depth[at];
                for (int k = 0; k < C; ++k) value[k] += weight * states.colour[k][at];
            }
            alpha[pixel] = total > 0 ? opaque / total : 0;
            depth[pixel] = opaque > 0 ? distance / opaque : 0;
            if (C == 1) {
                values[pixel] = value[0];
            } else if (tiles.channels) {
                values[pixel] = value[tiles.channels[pixel]];
            } else {
                for (int k = 0; k < C; ++k) values[C * pixel + k] = value[k];
            }
        });
    }
};

// Sums over the pixels of each pair, see `Sum`: a slot of slot_floats(C, Moving) for each.
template <int C, bool Moving>
struct Backward {
    static constexpr int kThreads = kTilePixels, kSlot = C == 1 && !Moving ? 8 : 16;
    Tiles tiles;
    States states;
    const float* d_values;
    float* slots;  // by pair
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        // What is still to come of the sum over colours of d_value times value: rest.
        struct Pixel {
            float x, y, time, t, rest, d[C];
            uint32_t end;
        };
        constexpr int kWarps = Block<kThreads>::kWarps;
        SPIKED_SHARED Entry entries[kBackwardBatch];
        SPIKED_SHARED uint32_t numbers[kBackwardBatch];
        SPIKED_SHARED float partial[kWarps][kBackwardBatch * kSlot];
        PerThread<Pixel, kThreads> pixels;
        PerThread<Sums<float, kSlot>, kThreads> sums;
        PerThread<bool, kThreads> some;
        const int tile = static_cast<int>(block.index) % tiles.tiles(),
                  sub_pose = static_cast<int>(block.index) / tiles.tiles();
        const int left = tile % tiles.camera.tiles_x * kTile, top = tile / tiles.camera.tiles_x * kTile;
        const uint32_t first = tiles.start[block.index], last = tiles.start[block.index + 1];
        block.each([&](int thread) {
            const TilePixel place = tile_pixel(thread);
            Pixel& pixel = pixels[thread];
            pixel = {place.x + 0.5f, place.y + 0.5f, 0, 1, 0, {}, 0};
            const int x = left + place.x, y = top + place.y;
            if (x >= tiles.camera.width || y >= tiles.camera.height) return;
            const int64_t at = static_cast<int64_t>(y) * tiles.camera.width + x;
            const int64_t state = static_cast<int64_t>(block.index) * kTilePixels + thread;
            float weight;
            tiles.exposure<Moving>(sub_pose, at, weight, pixel.time);
            pixel.end = states.end[state];
            for (int k = 0; k < C; ++k) {
                float d = C == 1 || tiles.channels ? d_values[at] : d_values[C * at + k];
                if (C > 1 && tiles.channels && tiles.channels[at] != k) d = 0;
                pixel.d[k] = d * weight;
                pixel.rest += d * weight * states.colour[k][state];
            }
        });
        for (uint32_t from = first; from < last; from += kBackwardBatch) {
            const int count = static_cast<int>(last - from < kBackwardBatch ? last - from : kBackwardBatch);
            const bool reached = block.any([&](int thread) { return pixels[thread].end > from - first; });
            block.each([&](int thread) {
                if (thread >= count) return;
                numbers[thread] = tiles.pairs[from + thread];
                if (reached)
                    entries[thread] =
                        tiles.entry<Moving>(numbers[thread], static_cast<float>(left), static_cast<float>(top), C);
            });
            block.sync();
            for (int i = 0; reached && i < count; ++i) {
                block.each([&](int thread) {
                    Pixel& pixel = pixels[thread];
                    some[thread] = add_pixel(entries[i], pixel, from - first + i < pixel.end, sums[thread]);
                });
                block.warp_sums(sums, some, &partial[0][i * kSlot], kBackwardBatch * kSlot);
            }
            block.sync();
            block.each([&](int thread) {
                for (int i = thread; i < count * kSlot; i += kThreads) {
                    float sum = 0;
                    if (reached)
                        for (int warp = 0; warp < kWarps; ++warp) sum += partial[warp][i];
                    slots[static_cast<int64_t>(numbers[i / kSlot]) * kSlot + i % kSlot] = sum;
                }
            });
            block.sync();
        }
    }

  private:
    // What one pixel adds to an entry's sums; false if nothing.
    template <class Pixel>
    SPIKED_DEVICE static bool add_pixel(const Entry& s, Pixel& pixel, bool open, Sums<float, kSlot>& out) {
        out = {};
        if (!open) return false;
        float u, w;
        const float log2_alpha = log2_alpha_at<Moving>(s, pixel.x, pixel.y, pixel.time, u, w);
        if (!(log2_alpha >= -kLog2Cut)) return false;
        const float uncapped = exp2f(log2_alpha), alpha = fminf(uncapped, kAlphaCap), share = alpha * pixel.t;
        float shown = 0, by_colour[C];
        for (int k = 0; k < C; ++k) {
            by_colour[k] = share * pixel.d[k];
            shown += s.colour[k] * by_colour[k];
        }
        pixel.rest -= shown;
        pixel.t -= share;
        const float v = uncapped > kAlphaCap ? 0.0f : shown - pixel.rest * (alpha / (1.0f - alpha));
        const float vu = v * u, vw = v * w;
        out.of[kV] = v, out.of[kVu] = vu, out.of[kVw] = vw;
        out.of[kVuu] = vu * u, out.of[kVuw] = vu * w, out.of[kVww] = vw * w;
        out.of[kShare] = share;
        for (int k = 0; k < C; ++k) out.of[kColour0 + k] = by_colour[k];
        if constexpr (Moving) {
            out.of[kVut] = vu * pixel.time;
            out.of[kVwt] = vw * pixel.time;
        }
        return true;
    }
};

// From the sums of the pairs to the gradients by the splats, a splat a thread, and to the sums of a block by the poses.
template <bool Bent, bool Moving>
struct Unproject {
    static constexpr int kThreads = kSplatThreads, kPose = Moving ? 16 : 8;  // sums by one or two poses
    Scene scene;
    const uint32_t *first_of_record, *pairs_of_record, *keys;
    const ProjectedSplat* records;
    const float* slots;
    int slot;  // floats of a slot
    GradientArrays out;
    double* partial;  // [blocks][poses][6]
    int poses;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        struct Gradient {
            float of[17], radius;
        };
        SPIKED_SHARED double totals[Block<kThreads>::kWarps][kPose];
        PerThread<Gradient, kThreads> gradients;
        PerThread<Sums<double, kPose>, kThreads> turns;
        PerThread<bool, kThreads> some;
        block.each([&](int thread) {
            for (float& value : gradients[thread].of) value = 0;
            gradients[thread].radius = 0;
        });
        double* pose = partial + static_cast<int64_t>(block.index) * poses * 6;
        block.each([&](int thread) {
            for (int i = thread; i < poses * 6; i += kThreads) pose[i] = 0;
        });
        block.sync();
        for (int sub_pose = 0; sub_pose < scene.poses.sub_poses; ++sub_pose) {
            block.each([&](int thread) {
                const int n = static_cast<int>(block.index) * kThreads + thread;
                turns[thread] = {};
                some[thread] = n < scene.splats.count && add_sub_pose(n, sub_pose, gradients[thread], turns[thread].of);
            });
            block.warp_sums(turns, some, &totals[0][0], kPose);
            block.sync();
            block.each([&](int thread) {
                if (thread >= (Moving ? 12 : 6)) return;
                double sum = 0;
                for (int warp = 0; warp < Block<kThreads>::kWarps; ++warp) sum += totals[warp][thread];
                pose[6 * sub_pose + thread] += sum;
            });
            block.sync();
        }
        block.each([&](int thread) {
            const int n = static_cast<int>(block.index) * kThreads + thread;
            if (n >= scene.splats.count) return;
            out.radius_px[n] = gradients[thread].radius;
            finish(scene.splats, scene.prepared, sums_in(n, gradients[thread].of), n, n + 1,
                   1.0f / scene.poses.sub_poses, out);
        });
    }

  private:
    SPIKED_DEVICE static SplatGradients sums_in(int n, float* at) {
        return {n,
                {at, at + 1, at + 2},
                {at + 3, at + 4, at + 5, at + 6, at + 7, at + 8, at + 9, at + 10, at + 11},
                at + 12,
                {at + 13, at + 14, at + 15},
                at + 16};
    }

    // Adds one sub-pose's gradients of a splat; false if it is not seen.
    template <class Gradient>
    SPIKED_DEVICE bool add_sub_pose(int n, int sub_pose, Gradient& gradient, double* turns) const {
        const int64_t record = static_cast<int64_t>(sub_pose) * scene.splats.count + n;
        if (keys[record] == kCulled) return false;
        gradient.radius = fmaxf(gradient.radius, records[record].radius);
        const uint32_t pairs = pairs_of_record[record];
        if (pairs == 0) return false;
        float sums[kSums] = {};
        const float* from = slots + static_cast<int64_t>(first_of_record[record]) * slot;
        const int used = Moving ? kSums : kColour0 + scene.splats.colours;
        for (uint32_t i = 0; i < pairs; ++i, from += slot)
#if defined(__CUDACC__)
#pragma unroll
#endif
            for (int k = 0; k < kSums; ++k)
                if (k < used) sums[k] += from[k];
        auto sum = [&](int which) { return Vec(sums[which]); };
        const SplatGradients into = sums_in(n, gradient.of);
        const Int seen = truth(true);
        if constexpr (Moving) {
            unproject_moving_at<Bent>(scene.prepared, scene.camera, scene.poses.sub_frames[sub_pose], n, seen, sum,
                                      scene.splats.colours, into, turns, turns + 6);
        } else {
            unproject_at<Bent>(scene.prepared, scene.camera, scene.poses.views[sub_pose], n, seen, sum,
                               scene.splats.colours, into, turns);
        }
        return true;
    }
};

// A step of Adam, a splat a thread (D. P. Kingma and J. Ba, 2015); see spiked/render/optimiser.py.
struct Descend {
    static constexpr int kThreads = kSplatThreads;
    int count, colours;
    float *means, *quats, *log_scales, *opacity_logits, *colour;
    GradientArrays gradients;
    float *first, *second;  // [count][11 + colours]
    uint32_t* taken;
    DescentRates rates;
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        block.each([&](int thread) {
            const int64_t n = static_cast<int64_t>(block.index) * kThreads + thread;
            if (n >= count) return;
            if (gradients.radius_px[n] > 0) {
                const uint32_t steps = taken[n] + (taken[n] != ~0u);
                taken[n] = steps;
                const double bias1 = 1 - pow(static_cast<double>(rates.beta1), static_cast<double>(steps));
                const double bias2 = 1 - pow(static_cast<double>(rates.beta2), static_cast<double>(steps));
                const float correction = static_cast<float>(::sqrt(bias2) / bias1);
                float *m = first + n * (11 + colours), *v = second + n * (11 + colours);
                float by_axes[3], along[3] = {};
                const SplatAxes splat{quats + 4 * n, log_scales + 3 * n, rates.blur, rates.own_axes};
                slopes_along_axes(splat, 0, 1, gradients.means + 3 * n, by_axes);
                move(along, by_axes, 0, 3, rates.rates[0] * correction, m, v);
                move(quats, gradients.quats, n, 4, rates.rates[1] * correction, m, v);
                move(log_scales, gradients.log_scales, n, 3, rates.rates[2] * correction, m, v);
                move_along_axes(splat, 0, 1, along, means + 3 * n);
                move(opacity_logits, gradients.opacity_logits, n, 1, rates.rates[3] * correction, m, v);
                move(colour, gradients.colour, n, colours, rates.rates[4] * correction, m, v);
            }
            for (int k = 0; k < colours; ++k) colour[n * colours + k] = fmaxf(colour[n * colours + k], 0);
            float square = 0;
            for (int k = 0; k < 3; ++k) {
                const float offset = means[3 * n + k] - rates.centre[k];
                square += offset * offset;
            }
            const float most = fminf(rates.most_log_scale, logf(rates.widest * sqrtf(square)));
            for (int k = 0; k < 3; ++k) log_scales[3 * n + k] = fminf(log_scales[3 * n + k], most);
        });
    }

  private:
    SPIKED_DEVICE void move(float* parameter, const float* gradient, int64_t n, int columns, float rate, float*& m,
                            float*& v) const {
        parameter += n * columns, gradient += n * columns;
        for (int k = 0; k < columns; ++k, ++m, ++v) {
            const float g = gradient[k];
            *m += (1 - rates.beta1) * (g - *m);
            *v += (1 - rates.beta2) * (g * g - *v);
            parameter[k] -= rate * *m / (sqrtf(*v) + rates.epsilon);
        }
    }
};

// What the blocks of another kernel have summed, summed over them; a block has one of the columns.
struct SumBlocks {
    static constexpr int kThreads = 256;
    const double* partial;  // [blocks][columns]
    int blocks, columns;
    double* out;  // [columns]
    SPIKED_DEVICE void operator()(const Block<kThreads>& block) const {
        SPIKED_SHARED double totals[Block<kThreads>::kWarps];
        PerThread<Sums<double, 1>, kThreads> sums;
        PerThread<bool, kThreads> some;
        block.each([&](int thread) {
            double sum = 0;
            for (int i = thread; i < blocks; i += kThreads)
                sum += partial[static_cast<int64_t>(i) * columns + block.index];
            sums[thread] = {{sum}};
            some[thread] = true;
        });
        block.sums(sums, some, totals, out + block.index);
    }
};

}  // namespace
}  // namespace spiked
