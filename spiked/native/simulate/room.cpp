#include "room.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <thread>

namespace spiked::simulate {
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

// A box as the camera sees it: in the box's own frame the ray of pixel (x, y) is origin + t (corner + x dx + y dy),
// where t is the z depth in the camera.
struct View {
    Vec origin, corner, dx, dy;
    int left, right, top, bottom;  // tiles that it may touch, inclusive
};

struct Hit {
    float depth = std::numeric_limits<float>::infinity();
    int box = -1, face = -1;
    int id() const { return box * 6 + face; }
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

void intersect(const Box& box, const View& view, int index, float x, float y, Hit& best) {
    float enter = kNear, leave = std::numeric_limits<float>::infinity();
    int enter_face = -1, leave_face = -1;
    for (int a = 0; a < 3; ++a) {
        const float d = view.corner[a] + x * view.dx[a] + y * view.dy[a];
        // A ray within the slab's plane divides by zero: the infinities and comparisons below do what is right.
        const float inverse = 1.0f / d;
        const float t0 = (-box.half[a] - view.origin[a]) * inverse, t1 = (box.half[a] - view.origin[a]) * inverse;
        const bool forward = d >= 0;
        const float in = forward ? t0 : t1, out = forward ? t1 : t0;
        if (in > enter) enter = in, enter_face = 2 * a + (forward ? 0 : 1);
        if (out < leave) leave = out, leave_face = 2 * a + (forward ? 1 : 0);
    }
    if (index == 0) {
        if (leave > kNear) best = {leave, 0, leave_face};
    } else if (enter_face >= 0 && enter < leave && enter < best.depth) {
        best = {enter, index, enter_face};
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

// Adds the texture's mean over the footprint of one sample, `size` pixels wide; Heckbert's footprint from exact
// derivatives, a few isotropic probes along its long axis.
template <int C>
void shade(const Room& room, const View& view, const Hit& hit, float x, float y, float size, float weight, float* sum) {
    const Box& box = room.boxes[static_cast<size_t>(hit.box)];
    const Texture& texture = room.textures[static_cast<size_t>(box.textures[hit.face])];
    const int a = hit.face / 2, axes[2] = {(a + 1) % 3, (a + 2) % 3};
    const float d = view.corner[a] + x * view.dx[a] + y * view.dy[a];
    const float slope_x = view.dx[a] / d, slope_y = view.dy[a] / d, k = texture.texels_per_unit;
    float at[2], along_x[2], along_y[2];
    for (int i = 0; i < 2; ++i) {
        const int b = axes[i];
        const float direction = view.corner[b] + x * view.dx[b] + y * view.dy[b];
        at[i] = k * (view.origin[b] + hit.depth * direction + box.half[b]);
        along_x[i] = k * size * hit.depth * (view.dx[b] - direction * slope_x);
        along_y[i] = k * size * hit.depth * (view.dy[b] - direction * slope_y);
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

    Hit cast(const std::vector<int>& candidates, float x, float y) const {
        Hit hit;
        for (const int b : candidates)
            intersect(room.boxes[static_cast<size_t>(b)], views[static_cast<size_t>(b)], b, x, y, hit);
        return hit;
    }

    template <int C>
    void paint_tile(int tile_x, int tile_y) const {
        std::vector<int> candidates;
        for (int b = 0; b < static_cast<int>(views.size()); ++b) {
            const View& view = views[static_cast<size_t>(b)];
            const bool touches =
                tile_x >= view.left && tile_x <= view.right && tile_y >= view.top && tile_y <= view.bottom;
            if (b == 0 || touches) candidates.push_back(b);
        }
        const int x0 = tile_x * kTile, y0 = tile_y * kTile;
        const int columns = std::min(kTile, camera.width - x0), rows = std::min(kTile, camera.height - y0);
        // With a border of one pixel, so that edges between tiles are seen from both sides.
        Hit hits[kTile + 2][kTile + 2];
        for (int y = -1; y <= rows; ++y) {
            for (int x = -1; x <= columns; ++x) {
                hits[y + 1][x + 1] =
                    cast(candidates, static_cast<float>(x0 + x) + 0.5f, static_cast<float>(y0 + y) + 0.5f);
            }
        }
        for (int y = 0; y < rows; ++y) {
            for (int x = 0; x < columns; ++x) {
                const Hit& hit = hits[y + 1][x + 1];
                const int id = hit.id();
                const bool inside = id == hits[y][x + 1].id() && id == hits[y + 2][x + 1].id() &&
                                    id == hits[y + 1][x].id() && id == hits[y + 1][x + 2].id();
                paint_pixel<C>(candidates, hit, inside, x0 + x, y0 + y);
            }
        }
    }

    template <int C>
    void paint_pixel(const std::vector<int>& candidates, const Hit& centre, bool inside, int x, int y) const {
        const int64_t at = static_cast<int64_t>(y) * camera.width + x;
        float sum[C] = {};
        depth[at] = centre.depth;
        if (inside) {
            shade<C>(room, views[static_cast<size_t>(centre.box)], centre, static_cast<float>(x) + 0.5f,
                     static_cast<float>(y) + 0.5f, 1.0f, 1.0f / 65535, sum);
        } else {
            for (int s = 0; s < kFine * kFine; ++s) {
                const float sx = static_cast<float>(x) + (static_cast<float>(s % kFine) + 0.5f) / kFine;
                const float sy = static_cast<float>(y) + (static_cast<float>(s / kFine) + 0.5f) / kFine;
                const Hit hit = cast(candidates, sx, sy);
                if (hit.box < 0) continue;
                shade<C>(room, views[static_cast<size_t>(hit.box)], hit, sx, sy, 1.0f / kFine,
                         1.0f / (65535 * kFine * kFine), sum);
            }
        }
        for (int c = 0; c < C; ++c) image[at * C + c] = sum[c];
    }
};

}  // namespace

void Room::render(const Pinhole& camera, float* image, float* depth, int threads) const {
    Painter painter{*this, camera, {}, image, depth};
    for (const Box& box : boxes) painter.views.push_back(view_of(box, camera));
    const int across = (camera.width + kTile - 1) / kTile, down = (camera.height + kTile - 1) / kTile;
    std::atomic<int> next{0};
    const auto work = [&] {
        for (int row = next++; row < down; row = next++) {
            for (int tile = 0; tile < across; ++tile) {
                if (channels == 1) {
                    painter.paint_tile<1>(tile, row);
                } else {
                    painter.paint_tile<3>(tile, row);
                }
            }
        }
    };
    std::vector<std::thread> helpers;
    for (int i = 1; i < threads; ++i) helpers.emplace_back(work);
    work();
    for (std::thread& helper : helpers) helper.join();
}

}  // namespace spiked::simulate
