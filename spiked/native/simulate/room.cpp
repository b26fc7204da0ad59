#include "room.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "../common/clones.hpp"
#include "../common/pool.hpp"

namespace spiked {
namespace {

constexpr int kTile = 16;
constexpr int kFine = 4;       // an edge pixel takes kFine x kFine samples
constexpr int kMaxProbes = 4;  // along the long axis of a slanted footprint
constexpr float kNear = 1e-3f;

struct Vec {
    float v[3];
    float operator[](int i) const { return v[i]; }
};

Vec to_local(const float* axes, const float* p) {
    Vec out;
    for (int i = 0; i < 3; ++i) out.v[i] = axes[3 * i] * p[0] + axes[3 * i + 1] * p[1] + axes[3 * i + 2] * p[2];
    return out;
}

// A box relative to the camera: in the box's own frame the ray of pixel (x, y) is origin + t (corner + x dx + y dy),
// where t is the z depth in the camera.
struct View {
    Vec origin, corner, dx, dy;
    int left, right, top, bottom;  // tiles that it may touch, inclusive
};

constexpr int kLanes = 32;
constexpr float kFar = 1e9f;

// Rays of one tile row or of one edge pixel side by side, so that the loop over them becomes vector instructions.
struct Rays {
    float x[kLanes], y[kLanes];
    float depth[kLanes];
    float surface[kLanes];  // box * 6 + face, -1 for nothing
};

View view_of(const Box& box, const Pinhole& camera) {
    View view;
    const float* r = camera.rotation;
    const float offset[3] = {camera.centre[0] - box.centre[0], camera.centre[1] - box.centre[1],
                             camera.centre[2] - box.centre[2]};
    const float dx[3] = {r[0] / camera.fx, r[3] / camera.fx, r[6] / camera.fx};
    const float dy[3] = {r[1] / camera.fy, r[4] / camera.fy, r[7] / camera.fy};
    float corner[3];
    for (int i = 0; i < 3; ++i) corner[i] = r[3 * i + 2] - camera.cx * dx[i] - camera.cy * dy[i];
    view.origin = to_local(box.axes, offset);
    view.dx = to_local(box.axes, dx);
    view.dy = to_local(box.axes, dy);
    view.corner = to_local(box.axes, corner);

    float low[2] = {1e9f, 1e9f}, high[2] = {-1e9f, -1e9f};
    int behind = 0;
    for (int c = 0; c < 8; ++c) {
        float world[3], cam[3];
        for (int i = 0; i < 3; ++i) {
            world[i] = -offset[i];
            for (int a = 0; a < 3; ++a) world[i] += ((c >> a & 1) ? 1.f : -1.f) * box.half[a] * box.axes[3 * a + i];
        }
        for (int i = 0; i < 3; ++i) cam[i] = r[i] * world[0] + r[3 + i] * world[1] + r[6 + i] * world[2];
        if (cam[2] < kNear) {
            ++behind;
            continue;
        }
        const float at[2] = {camera.fx * cam[0] / cam[2] + camera.cx, camera.fy * cam[1] / cam[2] + camera.cy};
        for (int i = 0; i < 2; ++i) {
            low[i] = std::min(low[i], at[i]);
            high[i] = std::max(high[i], at[i]);
        }
    }
    const auto tile = [](float pixel) { return static_cast<int>(std::floor(std::clamp(pixel, -1e6f, 1e6f) / kTile)); };
    view.left = tile(low[0] - 1), view.right = tile(high[0] + 1);
    view.top = tile(low[1] - 1), view.bottom = tile(high[1] + 1);
    if (behind == 8) view.right = view.left - 1;
    if (behind > 0 && behind < 8) view.left = view.top = 0, view.right = view.bottom = std::numeric_limits<int>::max();
    return view;
}

// Intersection of a ray with a box: inside between depths `enter` and `leave`, through faces that count from 0
// to 5.
struct BoxIntersection {
    float enter, leave, enter_face, leave_face;
};

SPIKED_INLINE BoxIntersection intersect_box(const float* half, const View& view, float x, float y) {
    float in[3], out[3], backwards[3];
    for (int a = 0; a < 3; ++a) {
        float d = view.corner.v[a] + x * view.dx.v[a] + y * view.dy.v[a];
        backwards[a] = d < 0.0f ? 1.0f : 0.0f;
        // A ray in the plane of a slab must give a large number: infinity would become NaN below.
        d += 1e-20f;
        const float t0 = (-half[a] - view.origin.v[a]) / d, t1 = (half[a] - view.origin.v[a]) / d;
        in[a] = t0 < t1 ? t0 : t1;
        out[a] = t0 < t1 ? t1 : t0;
    }
    // Arithmetic instead of conditions: GCC 12 compiles conditions to branches, which cannot be vectorised.
    const float in1 = in[1] > in[0] ? 1.0f : 0.0f, in01 = in[1] > in[0] ? in[1] : in[0];
    const float in2 = in[2] > in01 ? 1.0f : 0.0f, enter = in[2] > in01 ? in[2] : in01;
    const float out1 = out[1] < out[0] ? 1.0f : 0.0f, out01 = out[1] < out[0] ? out[1] : out[0];
    const float out2 = out[2] < out01 ? 1.0f : 0.0f, leave = out[2] < out01 ? out[2] : out01;
    const float enter01 = backwards[0] + in1 * (2.0f + backwards[1] - backwards[0]);
    const float leave01 = 1.0f - backwards[0] + out1 * (2.0f + backwards[0] - backwards[1]);
    return {enter, leave, enter01 + in2 * (4.0f + backwards[2] - enter01),
            leave01 + out2 * (5.0f - backwards[2] - leave01)};
}

SPIKED_CLONES void cast_shell(const float* half, const View& view, int count, Rays& rays) {
    for (int i = 0; i < count; ++i) {
        const BoxIntersection c = intersect_box(half, view, rays.x[i], rays.y[i]);
        const float hit = c.leave > kNear ? 1.0f : 0.0f;
        rays.depth[i] = hit * c.leave + (1.0f - hit) * kFar;
        rays.surface[i] = -1.0f + hit * (c.leave_face + 1.0f);
    }
}

SPIKED_CLONES void cast_box(const float* half, const View& view, int first_surface, int count, Rays& rays) {
    const float first = static_cast<float>(first_surface);
    for (int i = 0; i < count; ++i) {
        const BoxIntersection c = intersect_box(half, view, rays.x[i], rays.y[i]);
        const float hit = (c.enter < c.leave ? 1.0f : 0.0f) * (c.enter < rays.depth[i] ? 1.0f : 0.0f) *
                          (c.enter > kNear ? 1.0f : 0.0f);
        rays.depth[i] = hit * c.enter + (1.0f - hit) * rays.depth[i];
        rays.surface[i] = rays.surface[i] + hit * (first + c.enter_face - rays.surface[i]);
    }
}

// log2 to 0.09, continuous and monotonic: a level of detail needs no more.
float rough_log2(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    return static_cast<float>(static_cast<int32_t>(bits) - 0x3f800000) * (1.0f / (1 << 23));
}

template <int C>
void add_bilinear(const uint16_t* level, int width, int height, float u, float v, float weight, float* sum) {
    u = std::clamp(u - 0.5f, 0.0f, static_cast<float>(width - 1));
    v = std::clamp(v - 0.5f, 0.0f, static_cast<float>(height - 1));
    const int iu = std::min(static_cast<int>(u), std::max(width - 2, 0));
    const int iv = std::min(static_cast<int>(v), std::max(height - 2, 0));
    const float fu = u - static_cast<float>(iu), fv = v - static_cast<float>(iv);
    const uint16_t* top = level + (static_cast<int64_t>(iv) * width + iu) * C;
    const uint16_t* bottom = height > 1 ? top + static_cast<int64_t>(width) * C : top;
    const int next = width > 1 ? C : 0;
    for (int c = 0; c < C; ++c) {
        const float a = static_cast<float>(top[c]) + fu * (static_cast<float>(top[c + next]) - top[c]);
        const float b = static_cast<float>(bottom[c]) + fu * (static_cast<float>(bottom[c + next]) - bottom[c]);
        sum[c] += weight * (a + fv * (b - a));
    }
}

template <int C>
void add_trilinear(const Texture& texture, const uint16_t* texels, float u, float v, float detail, float weight,
                   float* sum) {
    detail = std::clamp(detail, 0.0f, static_cast<float>(texture.levels - 1));
    const int fine = static_cast<int>(detail);
    const float blend = detail - static_cast<float>(fine);
    const uint16_t* level = texels + texture.offset * C;
    int width = texture.width, height = texture.height;
    float scale = 1;
    for (int i = 0; i <= fine + 1 && i < texture.levels; ++i) {
        if (i == fine) add_bilinear<C>(level, width, height, u * scale, v * scale, weight * (1 - blend), sum);
        if (i == fine + 1 && blend > 0)
            add_bilinear<C>(level, width, height, u * scale, v * scale, weight * blend, sum);
        level += static_cast<int64_t>(width) * height * C;
        width = std::max(width / 2, 1), height = std::max(height / 2, 1);
        scale *= 0.5f;
    }
}

// Adds the mean of a surface's texture over the footprint of the pixel around (x, y): Heckbert's footprint from exact
// derivatives, a few isotropic probes along its long axis.
template <int C>
void shade(const Room& room, const std::vector<View>& views, int surface, float x, float y, float weight, float* sum) {
    const Box& box = room.boxes[static_cast<size_t>(surface / 6)];
    const View& view = views[static_cast<size_t>(surface / 6)];
    const int face = surface % 6;
    const Texture& texture = room.textures[static_cast<size_t>(box.textures[face])];
    const int a = face / 2, axes[2] = {(a + 1) % 3, (a + 2) % 3};
    const float d = view.corner[a] + x * view.dx[a] + y * view.dy[a];
    const float slope_x = view.dx[a] / d, slope_y = view.dy[a] / d, k = texture.texels_per_unit;
    const float depth = ((face % 2 == 1 ? box.half[a] : -box.half[a]) - view.origin[a]) / d;
    float at[2], along_x[2], along_y[2];
    for (int i = 0; i < 2; ++i) {
        const int b = axes[i];
        const float direction = view.corner[b] + x * view.dx[b] + y * view.dy[b];
        at[i] = k * (view.origin[b] + depth * direction + box.half[b]);
        along_x[i] = k * depth * (view.dx[b] - direction * slope_x);
        along_y[i] = k * depth * (view.dy[b] - direction * slope_y);
    }
    const float x2 = along_x[0] * along_x[0] + along_x[1] * along_x[1];
    const float y2 = along_y[0] * along_y[0] + along_y[1] * along_y[1];
    const float* major = x2 > y2 ? along_x : along_y;
    const float long2 = std::max(x2, y2), short2 = std::max(std::min(x2, y2), 1.0f);
    int probes = 1;
    while (probes < kMaxProbes && long2 > short2 * static_cast<float>(probes * probes) * 1.2f) ++probes;
    const float n = static_cast<float>(probes);
    const float detail = 0.5f * rough_log2(std::max({long2 / (n * n), short2, 1.0f}));
    for (int p = 0; p < probes; ++p) {
        const float shift = (static_cast<float>(p) + 0.5f) / n - 0.5f;
        add_trilinear<C>(texture, room.texels.data(), at[0] + shift * major[0], at[1] + shift * major[1], detail,
                         weight / n, sum);
    }
}

struct Painter {
    const Room& room;
    const Pinhole& camera;
    std::vector<View> views;
    float* image;
    float* depth;

    void cast(const std::vector<int>& candidates, int count, Rays& rays) const {
        cast_shell(room.boxes[0].half, views[0], count, rays);
        for (const int b : candidates) {
            cast_box(room.boxes[static_cast<size_t>(b)].half, views[static_cast<size_t>(b)], 6 * b, count, rays);
        }
    }

    template <int C>
    void paint_tile(int tile_x, int tile_y) const {
        std::vector<int> candidates;
        for (int b = 1; b < static_cast<int>(views.size()); ++b) {
            const View& view = views[static_cast<size_t>(b)];
            const bool touches =
                tile_x >= view.left && tile_x <= view.right && tile_y >= view.top && tile_y <= view.bottom;
            if (touches) candidates.push_back(b);
        }
        const int x0 = tile_x * kTile, y0 = tile_y * kTile;
        const int columns = std::min(kTile, camera.width - x0), rows = std::min(kTile, camera.height - y0);
        // With a border of one pixel, so that edges between tiles are found from both sides.
        Rays lines[kTile + 2];
        for (int y = -1; y <= rows; ++y) {
            Rays& line = lines[y + 1];
            for (int x = -1; x <= columns; ++x) {
                line.x[x + 1] = static_cast<float>(x0 + x) + 0.5f;
                line.y[x + 1] = static_cast<float>(y0 + y) + 0.5f;
            }
            cast(candidates, columns + 2, line);
        }
        for (int y = 0; y < rows; ++y) {
            for (int x = 0; x < columns; ++x) {
                const float surface = lines[y + 1].surface[x + 1], z = lines[y + 1].depth[x + 1];
                const bool inside = surface == lines[y].surface[x + 1] && surface == lines[y + 2].surface[x + 1] &&
                                    surface == lines[y + 1].surface[x] && surface == lines[y + 1].surface[x + 2];
                const int64_t at = static_cast<int64_t>(y0 + y) * camera.width + x0 + x;
                depth[at] = z < kFar ? z : std::numeric_limits<float>::infinity();
                float sum[C] = {};
                if (!inside) {
                    paint_edge<C>(candidates, static_cast<float>(x0 + x), static_cast<float>(y0 + y), sum);
                } else if (surface >= 0) {
                    shade<C>(room, views, static_cast<int>(surface), lines[y + 1].x[x + 1], lines[y + 1].y[x + 1],
                             1.0f / 65535, sum);
                }
                std::copy_n(sum, C, image + at * C);
            }
        }
    }

    // Each surface in the pixel counts by the area that a grid of rays gives it, and is shaded at that area's middle.
    template <int C>
    void paint_edge(const std::vector<int>& candidates, float left, float top, float* sum) const {
        constexpr int count = kFine * kFine;
        Rays rays;
        for (int i = 0; i < count; ++i) {
            rays.x[i] = left + (static_cast<float>(i % kFine) + 0.5f) / kFine;
            rays.y[i] = top + (static_cast<float>(i / kFine) + 0.5f) / kFine;
        }
        cast(candidates, count, rays);
        for (int i = 0; i < count; ++i) {
            const float surface = rays.surface[i];
            if (surface < 0) continue;
            float n = 0, x = 0, y = 0;
            for (int j = i; j < count; ++j) {
                if (rays.surface[j] != surface) continue;
                n += 1, x += rays.x[j], y += rays.y[j];
                rays.surface[j] = -1;
            }
            shade<C>(room, views, static_cast<int>(surface), x / n, y / n, n / (65535 * count), sum);
        }
    }
};

}  // namespace

void Room::render(const Pinhole& camera, float* image, float* depth, int threads) const {
    Painter painter{*this, camera, {}, image, depth};
    for (const Box& box : boxes) painter.views.push_back(view_of(box, camera));
    const int across = (camera.width + kTile - 1) / kTile, down = (camera.height + kTile - 1) / kTile;
    Pool(threads).run(down, [&](int row, int) {
        for (int tile = 0; tile < across; ++tile) {
            if (channels == 1) {
                painter.paint_tile<1>(tile, row);
            } else {
                painter.paint_tile<3>(tile, row);
            }
        }
    });
}

}  // namespace spiked
