// Splats to screen and gradients back; a GPU's threads run the same lines, a lane each (native/gpu). Notation: W world
// to camera, p = W (mu - c), J the Jacobian of the projection, M = J W (splat spread), Sigma2D = M M^T + 0.3 I.

namespace spiked {
namespace {

constexpr float kDilation = 0.3f;           // px^2, added to the projected covariance
constexpr float kLog2Cut = 7.994353437f;    // log2(255)
constexpr float kHalfLog2e = 0.721347520f;  // log2(e) / 2
constexpr float kLog2e = 1.442695041f;

// Through a lens only a part of the dilation is added to the covariance in its picture. The rest is added to that of a
// pinhole camera of the same focal length and bent with it, as two more columns of M: otherwise a map that was fitted
// where the lens shrinks the scene would have gaps when it is shown without distortion
// (docs/decisions/0023-lenses-in-the-projection.md).
constexpr float kLensDilation = 0.05f;  // px^2
constexpr float kBentDilation = 0.5f;   // px; its square and kLensDilation are kDilation
constexpr int kMostColumns = 5;
template <bool Bent>
constexpr int kColumns = Bent ? kMostColumns : 3;
template <bool Bent>
constexpr float kAdded = Bent ? kLensDilation : kDilation;

// Columns of an array of rows, kLanes rows from `first`; beyond the count the last row is repeated.
template <int Columns>
SPIKED_DEVICE static inline void read_rows(const float* rows, int first, int count, Vec out[Columns]) {
    alignas(64) float in[Columns][kLanes];
    for (int i = 0; i < kLanes; ++i) {
        const float* row = rows + (int64_t)Columns * (first + i < count ? first + i : count - 1);
        for (int k = 0; k < Columns; ++k) in[k][i] = row[k];
    }
    for (int k = 0; k < Columns; ++k) out[k] = load(in[k]);
}

template <int Columns>
SPIKED_DEVICE static inline void write_rows(float* rows, int first, int last, const Vec in[Columns]) {
    alignas(64) float out[Columns][kLanes];
    for (int k = 0; k < Columns; ++k) store(out[k], in[k]);
    for (int i = 0; i < kLanes && first + i < last; ++i)
        for (int k = 0; k < Columns; ++k) rows[(int64_t)Columns * (first + i) + k] = out[k][i];
}

// Makes a quaternion wxyz a unit one; returns the factor.
SPIKED_DEVICE static inline Vec normalise(Vec q[4]) {
    Vec scale = 1.0f / sqrt(max(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], broadcast(1e-24f)));
    for (int k = 0; k < 4; ++k) q[k] *= scale;
    return scale;
}

SPIKED_DEVICE static inline Vec scale_of(Vec log_scale) {
    return exp2_fine(clamp(log_scale, broadcast(-30.0f), broadcast(30.0f)) * kLog2e);
}

// A splat's axes, columns of a matrix (row-major): its rotation times diag(lengths). Makes the quaternion a unit one.
SPIKED_DEVICE static inline void axes_of(Vec quat[4], const Vec lengths[3], Vec axes[9]) {
    normalise(quat);
    Vec w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    Vec rotation[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                       2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                       2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    for (int k = 0; k < 3; ++k)
        for (int row = 0; row < 3; ++row) axes[3 * row + k] = rotation[3 * row + k] * lengths[k];
}

// The axes along which splats' means are moved by a step of 1: their own, as long as the standard deviations blurred by
// `blur`, or those of the world, as long as that.
SPIKED_DEVICE static inline void read_axes(const SplatAxes& splats, int first, int last, Vec axes[9]) {
    if (!splats.own) {
        for (int k = 0; k < 9; ++k) axes[k] = broadcast(k % 4 == 0 ? splats.blur : 0.0f);
        return;
    }
    Vec quat[4], length[3];
    read_rows<4>(splats.quats, first, last, quat);
    read_rows<3>(splats.log_scales, first, last, length);
    for (int k = 0; k < 3; ++k) {
        const Vec scale = scale_of(length[k]);
        length[k] = sqrt(scale * scale + splats.blur * splats.blur);
    }
    axes_of(quat, length, axes);
}

SPIKED_DEVICE static inline void slopes_along_axes(const SplatAxes& splats, int first, int last, const float* by_means,
                                                   float* by_axes) {
    for (int base = first; base < last; base += kLanes) {
        Vec axes[9], mean[3], along[3];
        read_axes(splats, base, last, axes);
        read_rows<3>(by_means, base, last, mean);
        for (int k = 0; k < 3; ++k) along[k] = axes[k] * mean[0] + axes[3 + k] * mean[1] + axes[6 + k] * mean[2];
        write_rows<3>(by_axes, base, last, along);
    }
}

SPIKED_DEVICE static inline void move_along_axes(const SplatAxes& splats, int first, int last, const float* steps,
                                                 float* means) {
    for (int base = first; base < last; base += kLanes) {
        Vec axes[9], step[3], mean[3];
        read_axes(splats, base, last, axes);
        read_rows<3>(steps, base, last, step);
        read_rows<3>(means, base, last, mean);
        for (int k = 0; k < 3; ++k)
            mean[k] += axes[3 * k] * step[0] + axes[3 * k + 1] * step[1] + axes[3 * k + 2] * step[2];
        write_rows<3>(means, base, last, mean);
    }
}

SPIKED_DEVICE static inline void prepare(const SplatArrays& splats, int first, int last, float* const mean[3],
                                         float* const spread[9], float* log2_opacity) {
    for (int base = first; base < last; base += kLanes) {
        Vec position[3], quat[4], log_scale[3], logit;
        read_rows<3>(splats.means, base, splats.count, position);
        read_rows<4>(splats.quats, base, splats.count, quat);
        read_rows<3>(splats.log_scales, base, splats.count, log_scale);
        read_rows<1>(splats.opacity_logits, base, splats.count, &logit);
        for (int k = 0; k < 3; ++k) store(mean[k] + base, position[k]);
        Vec scale[3], axes[9];
        for (int k = 0; k < 3; ++k) scale[k] = scale_of(log_scale[k]);
        axes_of(quat, scale, axes);
        for (int k = 0; k < 9; ++k) store(spread[k] + base, axes[k]);
        logit = clamp(logit, broadcast(-30.0f), broadcast(30.0f));
        store(log2_opacity + base, 0.0f - log2_fine(1.0f + exp2_fine(-kLog2e * logit)));
    }
}

// The distortion at a splat: derivatives of the bent slopes by the slopes, of first and of second order. They are
// symmetric: the bent slopes are a gradient.
struct BendLanes {
    Vec xx, xy, yy;
    Vec xxx, xxy, xyy, yyy;
};

struct ProjectionLanes {
    Vec offset[3];  // mu - c, world
    Vec x, y, z, over_z;
    Vec slope_x, slope_y;  // x/z and y/z, clamped
    Vec raw_x, raw_y;      // x/z and y/z
    Vec seen_x, seen_y;    // x/z and y/z, bent by the lens
    BendLanes bend;        // only with a lens
    Vec b[9];              // W times spread
    Vec m0[kMostColumns], m1[kMostColumns];
    Vec xx, xy, yy, determinant;
    Vec p, q, r;
};

// The angle to the axis of a slope r >= 0, to 2e-8 (M. Abramowitz and I. Stegun, "Handbook of mathematical functions",
// 4.4.49).
SPIKED_DEVICE static inline Vec arctangent(Vec r) {
    const Int steep = r > 1.0f;
    const Vec x = select(steep, 1.0f / max(r, broadcast(1e-6f)), r), t = x * x;
    constexpr float kTerms[] = {-0.0161657367f, 0.0429096138f, -0.0752896400f, 0.1065626393f,
                                -0.1420889944f, 0.1999355085f, -0.3333314528f, 1.0f};
    Vec sum = broadcast(0.0028662257f);
    for (int i = 0; i < 8; ++i) sum = sum * t + kTerms[i];
    const Vec angle = sum * x;
    return select(steep, 1.5707963268f - angle, angle);
}

// Bends the slopes of a projection.
SPIKED_DEVICE static inline void bend_lanes(const PinholeF& camera, ProjectionLanes& o) {
    const Vec x = o.raw_x, y = o.raw_y, square = x * x + y * y;
    const float* k = camera.coefficients;
    Vec scale, growth, curvature;  // the factor of the slopes, and its derivatives by the square
    float p1 = 0, p2 = 0;
    if (camera.lens == 1) {
        scale = 1.0f + square * (k[0] + square * (k[1] + square * k[4]));
        growth = k[0] + square * (2.0f * k[1] + 3.0f * k[4] * square);
        curvature = 2.0f * k[1] + 6.0f * k[4] * square;
        p1 = k[2], p2 = k[3];
    } else {
        const Vec s = max(square, broadcast(1e-4f)), r = sqrt(s), angle = arctangent(r), t = angle * angle;
        const Vec bent = angle * (1.0f + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
        const Vec first = 1.0f + t * (3.0f * k[0] + t * (5.0f * k[1] + t * (7.0f * k[2] + t * (9.0f * k[3]))));
        const Vec second = angle * (6.0f * k[0] + t * (20.0f * k[1] + t * (42.0f * k[2] + t * (72.0f * k[3]))));
        const Vec turn = 1.0f / (1.0f + s);  // derivative of the angle by r
        scale = bent / r;
        growth = (first * turn - scale) / (2.0f * s);
        curvature = (second * turn * turn / (2.0f * r) - first * turn * turn - 3.0f * growth) / (2.0f * s);
    }
    o.seen_x = x * scale + 2.0f * p1 * x * y + p2 * (square + 2.0f * x * x);
    o.seen_y = y * scale + p1 * (square + 2.0f * y * y) + 2.0f * p2 * x * y;
    BendLanes& b = o.bend;
    b.xx = scale + 2.0f * x * x * growth + 2.0f * p1 * y + 6.0f * p2 * x;
    b.xy = 2.0f * x * y * growth + 2.0f * p1 * x + 2.0f * p2 * y;
    b.yy = scale + 2.0f * y * y * growth + 6.0f * p1 * y + 2.0f * p2 * x;
    b.xxx = x * (6.0f * growth + 4.0f * x * x * curvature) + 6.0f * p2;
    b.xxy = y * (2.0f * growth + 4.0f * x * x * curvature) + 2.0f * p1;
    b.xyy = x * (2.0f * growth + 4.0f * y * y * curvature) + 2.0f * p2;
    b.yyy = y * (6.0f * growth + 4.0f * y * y * curvature) + 6.0f * p1;
    // What lies beyond the lens's reach is not drawn: it would be folded back.
    const Int drawn = square <= camera.reach2;
    o.z = select(drawn, o.z, Vec{});
    const float across = camera.fx / camera.fy, down = camera.fy / camera.fx;
    for (int i = 0; i < 3; ++i) {
        const Vec m0 = o.m0[i], m1 = o.m1[i];
        o.m0[i] = b.xx * m0 + across * b.xy * m1;
        o.m1[i] = down * b.xy * m0 + b.yy * m1;
    }
    o.m0[3] = kBentDilation * b.xx, o.m1[3] = kBentDilation * down * b.xy;
    o.m0[4] = kBentDilation * across * b.xy, o.m1[4] = kBentDilation * b.yy;
}

// The sums of squares of both rows of M, and the squared areas between its columns: the determinant of M M^T, free of
// the cancellation in xx yy - xy^2.
template <int Columns>
SPIKED_DEVICE static inline void squares_of(const Vec* a, const Vec* b, Vec& aa, Vec& bb, Vec& ab, Vec& area) {
    aa = bb = ab = area = Vec{};
    for (int i = 0; i < Columns; ++i) {
        aa += a[i] * a[i];
        bb += b[i] * b[i];
        ab += a[i] * b[i];
    }
    for (int k = 0; k < Columns; ++k)
        for (int step = 1; step <= Columns / 2; ++step) {
            const int i = (k + 1) % Columns, j = (k + 1 + step) % Columns;
            const Vec c = a[i] * b[j] - a[j] * b[i];
            area += c * c;
        }
}

template <bool Bent>
SPIKED_DEVICE static inline ProjectionLanes project_lanes(const Prepared& s, const PinholeF& camera, const View& view,
                                                          int base) {
    ProjectionLanes o;
    for (int k = 0; k < 3; ++k) o.offset[k] = (load(s.mean[k] + base) - view.centre_high[k]) - view.centre_low[k];
    const float* w = view.rotation;
    auto turn = [&](int row, Vec a, Vec b, Vec c) { return w[3 * row] * a + w[3 * row + 1] * b + w[3 * row + 2] * c; };
    o.x = turn(0, o.offset[0], o.offset[1], o.offset[2]);
    o.y = turn(1, o.offset[0], o.offset[1], o.offset[2]);
    o.z = turn(2, o.offset[0], o.offset[1], o.offset[2]);
    for (int k = 0; k < 3; ++k) {
        Vec a = load(s.spread[k] + base), b = load(s.spread[3 + k] + base), c = load(s.spread[6 + k] + base);
        for (int row = 0; row < 3; ++row) o.b[3 * row + k] = turn(row, a, b, c);
    }
    o.over_z = 1.0f / o.z;
    o.raw_x = o.x * o.over_z;
    o.raw_y = o.y * o.over_z;
    o.slope_x = clamp(o.raw_x, broadcast(-camera.limit_x), broadcast(camera.limit_x));
    o.slope_y = clamp(o.raw_y, broadcast(-camera.limit_y), broadcast(camera.limit_y));
    Vec jx = camera.fx * o.over_z, jy = camera.fy * o.over_z;
    for (int k = 0; k < 3; ++k) {
        o.m0[k] = jx * (o.b[k] - o.slope_x * o.b[6 + k]);
        o.m1[k] = jy * (o.b[3 + k] - o.slope_y * o.b[6 + k]);
    }
    if constexpr (Bent) bend_lanes(camera, o);
    constexpr float added = kAdded<Bent>;
    Vec aa, bb, area;
    squares_of<kColumns<Bent>>(o.m0, o.m1, aa, bb, o.xy, area);
    o.xx = aa + added;
    o.yy = bb + added;
    o.determinant = area + added * (aa + bb) + added * added;
    o.p = sqrt(kHalfLog2e * o.yy / o.determinant);
    o.q = -kHalfLog2e * o.xy / (o.determinant * o.p);
    o.r = sqrt(kHalfLog2e / o.yy);
    return o;
}

constexpr float kMargin = 0.01f;  // px; absorbs rounding, costs next to nothing

// How far to the left and to the right of its mean a splat's ellipse reaches in bands of rows, times its p; from `low`
// to `high`, rows from its mean, not beyond the ellipse.
SPIKED_DEVICE static inline void extent_in_rows(const ProjectedSplat& s, Vec low, Vec high, Vec& left, Vec& right) {
    const float reach = s.log2_opacity + kLog2Cut;
    Vec right_dy = clamp(broadcast(s.extreme), low, high), left_dy = clamp(broadcast(-s.extreme), low, high);
    right = sqrt(max(reach - s.r * s.r * right_dy * right_dy, Vec{})) - s.q * right_dy;
    left = -sqrt(max(reach - s.r * s.r * left_dy * left_dy, Vec{})) - s.q * left_dy;
}

// Writes kLanes records of visible splats, and their keys.
SPIKED_DEVICE static inline void write_records(const Vec fields[kRecordFields], Int visible, int base, int count,
                                               ProjectedSplat* records, uint32_t* keys) {
    alignas(64) float out[kRecordFields][kLanes];
    alignas(64) int32_t seen[kLanes];
    for (int k = 0; k < kRecordFields; ++k) store(out[k], fields[k]);
    memcpy(seen, &visible, sizeof seen);
    for (int i = 0; i < kLanes && base + i < count; ++i) {
        keys[base + i] = kCulled;
        if (!seen[i]) continue;
        memcpy(&keys[base + i], &out[6][i], 4);
        // The fields are the record's first floats, in order.
        float* record = &records[base + i].x;
        for (int k = 0; k < kRecordFields; ++k) record[k] = out[k][i];
    }
}

template <bool Bent>
SPIKED_DEVICE static inline void project_by(const Prepared& splats, const PinholeF& camera, const View& view, int count,
                                            int first, int last, ProjectedSplat* records, uint32_t* keys) {
    for (int base = first; base < last; base += kLanes) {
        ProjectionLanes o = project_lanes<Bent>(splats, camera, view, base);
        const Vec &x = Bent ? o.seen_x : o.raw_x, &y = Bent ? o.seen_y : o.raw_y;
        Vec u = x * camera.fx + camera.cx, v = y * camera.fy + camera.cy;
        Vec log2_opacity = load(splats.log2_opacity + base);
        Vec reach = log2_opacity + kLog2Cut;  // u^2 + w^2 at the rim
        Vec half_x = sqrt(max(reach, broadcast(0.0f)) * o.xx / kHalfLog2e);
        Vec half_y = sqrt(max(reach, broadcast(0.0f)) * o.yy / kHalfLog2e);
        Vec middle = 0.5f * (o.xx + o.yy), spread = 0.5f * (o.xx - o.yy);
        Vec largest = middle + sqrt(spread * spread + o.xy * o.xy);
        Vec radius = sqrt(max(reach, broadcast(0.0f)) * largest / kHalfLog2e);
        Int inside = (u + half_x >= 0.5f) & (u - half_x <= camera.width - 0.5f) & (v + half_y >= 0.5f) &
                     (v - half_y <= camera.height - 0.5f);
        Int sound = is_finite(u + v) & is_finite(o.determinant) & is_finite(radius) & (o.p > 0.0f) & is_finite(o.q);
        Int visible = inside & sound & (o.z >= camera.near) & (reach >= 0.0f);
        const Vec fields[kRecordFields] = {
            u, v, o.p, o.q, o.r, log2_opacity, o.z, radius, half_x, half_y, o.xy / o.xx * half_x, 1.0f / o.p};
        write_records(fields, visible, base, count, records, keys);
    }
}

SPIKED_DEVICE static inline void project(const Prepared& splats, const PinholeF& camera, const View& view, int count,
                                         int first, int last, ProjectedSplat* records, uint32_t* keys) {
    (camera.lens ? project_by<true> : project_by<false>)(splats, camera, view, count, first, last, records, keys);
}

SPIKED_DEVICE static inline void add(float* p, Vec v) { store(p, load(p) + v); }

// From gradients by what the lens shows to gradients by what a camera without distortion would show.
SPIKED_DEVICE static inline void straighten_gradients(const PinholeF& camera, const ProjectionLanes& o, Vec& g_u,
                                                      Vec& g_v, Vec* d_m0, Vec* d_m1, Vec& d_x, Vec& d_y) {
    const BendLanes& b = o.bend;
    const float across = camera.fx / camera.fy, down = camera.fy / camera.fx;
    const Vec u = g_u, v = g_v;
    g_u = b.xx * u + down * b.xy * v;
    g_v = across * b.xy * u + b.yy * v;
    Vec xx{}, mixed{}, yy{};  // by the derivatives of the lens
    for (int k = 0; k < 3; ++k) {
        const Vec n0 = (o.b[k] - o.slope_x * o.b[6 + k]) * o.over_z;
        const Vec n1 = (o.b[3 + k] - o.slope_y * o.b[6 + k]) * o.over_z;
        const Vec d0 = d_m0[k], d1 = d_m1[k];
        xx += camera.fx * d0 * n0;
        mixed += camera.fx * d0 * n1 + camera.fy * d1 * n0;
        yy += camera.fy * d1 * n1;
        d_m0[k] = b.xx * d0 + down * b.xy * d1;
        d_m1[k] = across * b.xy * d0 + b.yy * d1;
    }
    xx += kBentDilation * d_m0[3];
    mixed += kBentDilation * (down * d_m1[3] + across * d_m0[4]);
    yy += kBentDilation * d_m1[4];
    d_x = xx * b.xxx + mixed * b.xxy + yy * b.xyy;
    d_y = xx * b.xxy + mixed * b.xyy + yy * b.yyy;
}

// Adds the gradients of one projection by the splat and the pose: g_u, g_v by the mean on screen, by_m0, by_m1 by M's
// rows.
template <bool Bent>
SPIKED_DEVICE static inline void unproject_lanes(const Prepared& splats, const PinholeF& camera, const View& view,
                                                 const ProjectionLanes& o, Int seen, int base, int into, Vec g_u,
                                                 Vec g_v, const Vec* by_m0, const Vec* by_m1, const SplatGradients& out,
                                                 double pose[6]) {
    Vec jx = camera.fx * o.over_z, jy = camera.fy * o.over_z;
    Vec d_spread[9], d_jx{}, d_jy{}, d_jxz{}, d_jyz{};
    Vec d_m0[kMostColumns], d_m1[kMostColumns];
    for (int k = 0; k < kColumns<Bent>; ++k) d_m0[k] = by_m0[k], d_m1[k] = by_m1[k];
    Vec d_x{}, d_y{};  // by the slopes, through the derivatives of the lens
    if constexpr (Bent) straighten_gradients(camera, o, g_u, g_v, d_m0, d_m1, d_x, d_y);
    for (int k = 0; k < 3; ++k) {
        const Vec d0 = d_m0[k], d1 = d_m1[k];
        d_jx += d0 * o.b[k];
        d_jy += d1 * o.b[3 + k];
        d_jxz += d0 * o.b[6 + k];
        d_jyz += d1 * o.b[6 + k];
        Vec b0 = jx * d0, b1 = jy * d1, b2 = -(jx * o.slope_x * d0 + jy * o.slope_y * d1);
        for (int row = 0; row < 3; ++row) {
            const float* w = view.rotation + row;
            d_spread[3 * row + k] = select(seen, w[0] * b0 + w[3] * b1 + w[6] * b2, Vec{});
        }
    }
    Vec over_z2 = o.over_z * o.over_z;
    // Where the slope is clamped, jxz = -fx slope / z depends on z only.
    Vec free_x = select(o.slope_x == o.raw_x, broadcast(1.0f), Vec{});
    Vec free_y = select(o.slope_y == o.raw_y, broadcast(1.0f), Vec{});
    Vec gx = jx * g_u - free_x * camera.fx * over_z2 * d_jxz;
    Vec gy = jy * g_v - free_y * camera.fy * over_z2 * d_jyz;
    Vec gz = camera.fx * over_z2 * (o.slope_x * d_jxz + free_x * o.raw_x * d_jxz - d_jx - o.x * g_u) +
             camera.fy * over_z2 * (o.slope_y * d_jyz + free_y * o.raw_y * d_jyz - d_jy - o.y * g_v);
    if constexpr (Bent) {
        gx += d_x * o.over_z;
        gy += d_y * o.over_z;
        gz -= (d_x * o.raw_x + d_y * o.raw_y) * o.over_z;
    }
    Vec d_mean[3];
    for (int k = 0; k < 3; ++k) {
        const float* w = view.rotation + k;
        d_mean[k] = select(seen, w[0] * gx + w[3] * gy + w[6] * gz, Vec{});
        add(out.mean[k] + into, d_mean[k]);
    }
    for (int k = 0; k < 9; ++k) add(out.spread[k] + into, d_spread[k]);

    for (int k = 0; k < 3; ++k) {
        int a = (k + 1) % 3, b = (k + 2) % 3;
        Vec turn = d_mean[a] * o.offset[b] - d_mean[b] * o.offset[a];
        for (int j = 0; j < 3; ++j)
            turn -= d_spread[3 * b + j] * load(splats.spread[3 * a + j] + base) -
                    d_spread[3 * a + j] * load(splats.spread[3 * b + j] + base);
        turn = select(seen, turn, Vec{});
        for (int i = 0; i < kLanes; ++i) {
            pose[k] += turn[i];
            pose[3 + k] += d_mean[k][i];
        }
    }
}

// The gradients of the splats from `base` on by the sums over their pixels: sum(which) is one of `Sum`.
template <bool Bent, class Sums>
SPIKED_DEVICE SPIKED_INLINED static inline void unproject_at(const Prepared& splats, const PinholeF& camera,
                                                             const View& view, int base, Int seen, Sums sum,
                                                             int colours, const SplatGradients& out, double pose[6]) {
    const int into = base - out.first;
    add(out.log_opacity + into, sum(kV));
    add(out.share + into, sum(kShare));
    for (int k = 0; k < colours; ++k) add(out.colour[k] + into, sum(kColour0 + k));

    ProjectionLanes o = project_lanes<Bent>(splats, camera, view, base);
    // Offsets times the conic are (p u, q u + r w) / kHalfLog2e, so nothing has to be inverted.
    constexpr float scale = 1.0f / kHalfLog2e;
    Vec su = sum(kVu), sw = sum(kVw), suu = sum(kVuu), suw = sum(kVuw), sww = sum(kVww);
    Vec g_u = scale * o.p * su, g_v = scale * (o.q * su + o.r * sw);
    Vec c_xx = scale * scale * o.p * o.p * suu;  // twice dL/dSigma2D
    Vec c_xy = scale * scale * o.p * (o.q * suu + o.r * suw);
    Vec c_yy = scale * scale * (o.q * (o.q * suu + 2 * o.r * suw) + o.r * o.r * sww);

    Vec d_m0[kMostColumns], d_m1[kMostColumns];
    for (int k = 0; k < kColumns<Bent>; ++k) {
        d_m0[k] = c_xx * o.m0[k] + c_xy * o.m1[k];
        d_m1[k] = c_xy * o.m0[k] + c_yy * o.m1[k];
    }
    unproject_lanes<Bent>(splats, camera, view, o, seen, base, into, g_u, g_v, d_m0, d_m1, out, pose);
}

template <bool Bent>
SPIKED_DEVICE static inline void unproject_by(const Prepared& splats, const PinholeF& camera, const View& view,
                                              int first, const float* sums, const uint8_t* visible, int colours,
                                              const SplatGradients& out, double pose[6]) {
    for (int at = 0; at < kGroup; at += kLanes) {
        Int seen;
        for (int i = 0; i < kLanes; ++i) seen[i] = visible[at + i] ? -1 : 0;
        auto sum = [&](int which) { return load(sums + which * kGroup + at); };
        unproject_at<Bent>(splats, camera, view, first + at, seen, sum, colours, out, pose);
    }
}

SPIKED_DEVICE static inline void unproject(const Prepared& splats, const PinholeF& camera, const View& view, int first,
                                           const float* sums, const uint8_t* visible, int colours,
                                           const SplatGradients& out, double pose[6]) {
    auto* run = camera.lens ? unproject_by<true> : unproject_by<false>;
    run(splats, camera, view, first, sums, visible, colours, out, pose);
}

SPIKED_DEVICE static inline void finish(const SplatArrays& splats, const Prepared& prepared, const SplatGradients& sums,
                                        int first, int last, float share_scale, const GradientArrays& out) {
    for (int base = first; base < last; base += kLanes) {
        const int from = base - sums.first;
        Vec radius, logit, quat[4], log_scale[3];
        read_rows<1>(out.radius_px, base, last, &radius);
        read_rows<1>(splats.opacity_logits, base, last, &logit);
        read_rows<4>(splats.quats, base, last, quat);
        read_rows<3>(splats.log_scales, base, last, log_scale);
        // A splat that was never visible may have values that are not finite.
        const Int seen = radius > 0.0f;
        auto write = [&](float* rows, Vec v) {
            v = select(seen, v, Vec{});
            write_rows<1>(rows, base, last, &v);
        };
        write(out.contribution, load(sums.share + from) * share_scale);
        write(out.opacity_logits, load(sums.log_opacity + from) /
                                      (1.0f + exp2_fine(clamp(logit, broadcast(-30.0f), broadcast(30.0f)) * kLog2e)));

        Vec mean[3], colour[3], d[9], d_log_scale[3];  // d: of the rotation, row-major
        for (int k = 0; k < 3; ++k) mean[k] = load(sums.mean[k] + from);
        write_rows<3>(out.means, base, last, mean);
        for (int k = 0; k < splats.colours; ++k) colour[k] = load(sums.colour[k] + from);
        if (splats.colours == 1) write_rows<1>(out.colour, base, last, colour);
        if (splats.colours == 3) write_rows<3>(out.colour, base, last, colour);
        for (int j = 0; j < 3; ++j) {
            Vec scale = scale_of(log_scale[j]), along{};
            for (int i = 0; i < 3; ++i) {
                Vec g = load(sums.spread[3 * i + j] + from);
                along += g * load(prepared.spread[3 * i + j] + base);
                d[3 * i + j] = g * scale;
            }
            d_log_scale[j] = select(seen, along, Vec{});
        }
        write_rows<3>(out.log_scales, base, last, d_log_scale);

        const Vec over = normalise(quat);
        const Vec w = quat[0], x = quat[1], y = quat[2], z = quat[3];
        Vec g[4] = {2.0f * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
                    2.0f * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - 2.0f * x * (d[4] + d[8])),
                    2.0f * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - 2.0f * y * (d[0] + d[8])),
                    2.0f * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - 2.0f * z * (d[0] + d[4]))};
        const Vec radial = w * g[0] + x * g[1] + y * g[2] + z * g[3];
        for (int k = 0; k < 4; ++k) g[k] = select(seen, (g[k] - quat[k] * radial) * over, Vec{});
        write_rows<4>(out.quats, base, last, g);
    }
}

}  // namespace
}  // namespace spiked
