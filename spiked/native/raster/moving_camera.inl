// A camera that moves from one pose to another during a sub-frame. On screen each splat moves in a straight line: its
// mean and the columns of M (whose M M^T is its covariance) are the averages of those at both ends, and the rest of its
// motion during the window of a pixel is a blur by moment matching, Sigma2D += blur v v^T with the opacity times the
// square root of the determinants' ratio (docs/decisions/0005-motion-aware-rendering.md). Each pixel is rendered at its
// own time.

namespace spiked {
namespace {

struct Covered {
    float weight;  // share of the pixel's window that lies in the sub-frame
    float time;    // of the middle of that part, from the middle of the sub-frame
    float length;  // of that part
};

SPIKED_DEVICE static inline Covered covered_by(const Planes& planes, int64_t at) {
    const float start = planes.start[at], stop = planes.stop[at];
    const float from = start > planes.sub_frame ? start : planes.sub_frame;
    const float to = stop < planes.sub_frame + 1 ? stop : planes.sub_frame + 1;
    const float length = to - from;
    if (!(length > 0)) return {0, 0, 0};
    return {length / (stop - start), 0.5f * (from - planes.sub_frame + (to - planes.sub_frame)) - 0.5f, length};
}

SPIKED_DEVICE static inline void cover(const Planes& planes, int64_t count, double* weight, double* square,
                                       float* time_reach) {
    constexpr int64_t kRun = 1024;
    double weights = 0, squares = 0;
    float farthest = 0;
    for (int64_t from = 0; from < count; from += kRun) {
        const int64_t end = count - from < kRun ? count : from + kRun;
        Vec w{}, s{}, far{};
        int64_t at = from;
        for (; at + kLanes <= end; at += kLanes) {
            const Vec start = load(planes.start + at), stop = load(planes.stop + at);
            const Vec a = max(start, broadcast(planes.sub_frame)), b = min(stop, broadcast(planes.sub_frame + 1));
            const Vec length = b - a;
            const Int covered = length > 0.0f;
            const Vec share = select(covered, length / (stop - start), Vec{});
            const Vec time = 0.5f * ((a - planes.sub_frame) + (b - planes.sub_frame)) - 0.5f;
            w += share;
            s += select(covered, share * length * length, Vec{});
            far = max(far, select(covered, max(time, -time), Vec{}));
        }
        for (int lane = 0; lane < kLanes; ++lane) {
            weights += w[lane];
            squares += s[lane];
            farthest = far[lane] > farthest ? far[lane] : farthest;
        }
        for (; at < end; ++at) {
            const Covered part = covered_by(planes, at);
            weights += part.weight;
            squares += part.weight * part.length * part.length;
            const float time = part.time < 0 ? -part.time : part.time;
            farthest = time > farthest ? time : farthest;
        }
    }
    *weight = weights;
    *square = squares;
    *time_reach = farthest;
}

struct SubFrameProjection {
    ProjectionLanes begin, end;
    Vec u, v, du, dv;                                             // mean in the middle, px; motion from begin to end
    Vec m0[kMostColumns], m1[kMostColumns];                       // averages of M's rows
    Vec xx, xy, yy, determinant;                                  // of the covariance in the middle
    Vec blurred_xx, blurred_xy, blurred_yy, blurred_determinant;  // with the blur
    Vec p, q, r;                                                  // of the blurred covariance
};

template <bool Bent>
SPIKED_DEVICE static inline SubFrameProjection project_sub_frame(const Prepared& s, const PinholeF& camera,
                                                                 const SubFrame& sub_frame, int base) {
    SubFrameProjection o;
    o.begin = project_lanes<Bent>(s, camera, sub_frame.begin, base);
    o.end = project_lanes<Bent>(s, camera, sub_frame.end, base);
    const ProjectionLanes &b = o.begin, &e = o.end;
    const Vec &bx = Bent ? b.seen_x : b.raw_x, &by = Bent ? b.seen_y : b.raw_y;
    const Vec &ex = Bent ? e.seen_x : e.raw_x, &ey = Bent ? e.seen_y : e.raw_y;
    o.u = 0.5f * camera.fx * (bx + ex) + camera.cx;
    o.v = 0.5f * camera.fy * (by + ey) + camera.cy;
    o.du = camera.fx * (ex - bx);
    o.dv = camera.fy * (ey - by);
    Vec swept{};
    for (int k = 0; k < kColumns<Bent>; ++k) {
        o.m0[k] = 0.5f * (b.m0[k] + e.m0[k]);
        o.m1[k] = 0.5f * (b.m1[k] + e.m1[k]);
        const Vec beside = o.m0[k] * o.dv - o.m1[k] * o.du;
        swept += beside * beside;
    }
    constexpr float added = kAdded<Bent>;
    Vec along, across, area;
    squares_of<kColumns<Bent>>(o.m0, o.m1, along, across, o.xy, area);
    o.xx = along + added;
    o.yy = across + added;
    o.determinant = area + added * (along + across) + added * added;
    o.blurred_xx = o.xx + sub_frame.blur * o.du * o.du;
    o.blurred_xy = o.xy + sub_frame.blur * o.du * o.dv;
    o.blurred_yy = o.yy + sub_frame.blur * o.dv * o.dv;
    o.blurred_determinant = o.determinant + sub_frame.blur * (swept + added * (o.du * o.du + o.dv * o.dv));
    o.p = sqrt(kHalfLog2e * o.blurred_yy / o.blurred_determinant);
    o.q = -kHalfLog2e * o.blurred_xy / (o.blurred_determinant * o.p);
    o.r = sqrt(kHalfLog2e / o.blurred_yy);
    return o;
}

template <bool Bent>
SPIKED_DEVICE static inline void project_moving_by(const Prepared& splats, const PinholeF& camera,
                                                   const SubFrame& sub_frame, int count, int first, int last,
                                                   ProjectedSplat* records, Motion* motions, uint32_t* keys) {
    alignas(64) float out[6][kLanes];
    for (int base = first; base < last; base += kLanes) {
        const SubFrameProjection o = project_sub_frame<Bent>(splats, camera, sub_frame, base);
        const Vec z = 0.5f * (o.begin.z + o.end.z);
        const Vec log2_opacity =
            load(splats.log2_opacity + base) - 0.5f * log2_fine(o.blurred_determinant / o.determinant);
        const Vec reach = log2_opacity + kLog2Cut;  // u^2 + w^2 at the rim
        const Vec u_rate = o.p * o.du + o.q * o.dv, w_rate = o.r * o.dv;

        // An ellipse around the one at the rim, swept along the motion: with weights s, the sum of two ellipsoids
        // lies in the one of (1 + 1/s) Q1 + (1 + s) Q2. This s makes it smallest in the metric of the splat.
        const Vec rim = max(reach, broadcast(1e-3f));
        const Vec step = sub_frame.time_reach * max(sqrt(u_rate * u_rate + w_rate * w_rate), broadcast(1e-5f));
        const Vec s = sqrt(2.0f * rim) / max(step, broadcast(1e-6f));
        const Vec wide = 1.0f + 1.0f / s;
        const Vec longer = (1.0f + s) * (kHalfLog2e * sub_frame.time_reach * sub_frame.time_reach) / rim;
        const Vec xx = wide * o.blurred_xx + longer * o.du * o.du, yy = wide * o.blurred_yy + longer * o.dv * o.dv;
        const Vec xy = wide * o.blurred_xy + longer * o.du * o.dv;
        const Vec determinant =
            wide * o.blurred_determinant * (wide + longer * (u_rate * u_rate + w_rate * w_rate) * (1.0f / kHalfLog2e));
        const Vec p = sqrt(kHalfLog2e * yy / determinant);
        const Vec q = -kHalfLog2e * xy / (determinant * p), r = sqrt(kHalfLog2e / yy);
        const Vec half_x = sqrt(rim * xx * (1.0f / kHalfLog2e)), half_y = sqrt(rim * yy * (1.0f / kHalfLog2e));
        const Vec middle = 0.5f * (xx + yy), spread = 0.5f * (xx - yy);
        const Vec radius = sqrt(rim * (middle + sqrt(spread * spread + xy * xy)) * (1.0f / kHalfLog2e));
        const Int inside = (o.u + half_x >= 0.5f) & (o.u - half_x <= camera.width - 0.5f) & (o.v + half_y >= 0.5f) &
                           (o.v - half_y <= camera.height - 0.5f);
        const Int sound = is_finite(o.u + o.v) & is_finite(o.du + o.dv) & is_finite(o.blurred_determinant) &
                          is_finite(determinant) & is_finite(radius) & (o.p > 0.0f) & is_finite(o.q) & (p > 0.0f) &
                          is_finite(q) & is_finite(s);
        const Int visible = inside & sound & (o.begin.z >= camera.near) & (o.end.z >= camera.near) & (reach >= 0.0f);
        const Vec fields[kRecordFields] = {
            o.u, o.v, p, q, r, rim - kLog2Cut, z, radius, half_x, half_y, xy / xx * half_x, 1.0f / p};
        write_records(fields, visible, base, count, records, keys);
        const Vec motion[6] = {o.p, o.q, o.r, log2_opacity, u_rate, w_rate};
        for (int k = 0; k < 6; ++k) store(out[k], motion[k]);
        for (int i = 0; i < kLanes && base + i < count; ++i)
            motions[base + i] = {out[0][i], out[1][i], out[2][i], out[3][i], out[4][i], out[5][i], {}};
    }
}

SPIKED_DEVICE static inline void project_moving(const Prepared& splats, const PinholeF& camera,
                                                const SubFrame& sub_frame, int count, int first, int last,
                                                ProjectedSplat* records, Motion* motions, uint32_t* keys) {
    auto* run = camera.lens ? project_moving_by<true> : project_moving_by<false>;
    run(splats, camera, sub_frame, count, first, last, records, motions, keys);
}

// As unproject_at, by the poses at both ends of the sub-frame.
template <bool Bent, class Sums>
SPIKED_DEVICE SPIKED_INLINED static inline void unproject_moving_at(const Prepared& splats, const PinholeF& camera,
                                                                    const SubFrame& sub_frame, int base, Int seen,
                                                                    Sums sum, int colours, const SplatGradients& out,
                                                                    double pose_begin[6], double pose_end[6]) {
    const int into = base - out.first;
    const Vec opacity = sum(kV);
    add(out.log_opacity + into, opacity);
    add(out.share + into, sum(kShare));
    for (int k = 0; k < colours; ++k) add(out.colour[k] + into, sum(kColour0 + k));

    const SubFrameProjection o = project_sub_frame<Bent>(splats, camera, sub_frame, base);
    constexpr float scale = 1.0f / kHalfLog2e;
    const Vec suu = sum(kVuu), suw = sum(kVuw), sww = sum(kVww);
    const Vec g_u = scale * o.p * sum(kVu), g_v = scale * (o.q * sum(kVu) + o.r * sum(kVw));
    // Twice dL/dSigma2D of the blurred covariance, the blurred opacity's part included.
    const Vec fade = opacity / o.blurred_determinant;
    const Vec b_xx = scale * scale * o.p * o.p * suu - fade * o.blurred_yy;
    const Vec b_xy = scale * scale * o.p * (o.q * suu + o.r * suw) + fade * o.blurred_xy;
    const Vec b_yy = scale * scale * (o.q * (o.q * suu + 2 * o.r * suw) + o.r * o.r * sww) - fade * o.blurred_xx;
    // By the motion: through the position at a pixel's time, and through the blur.
    const Vec g_du = scale * o.p * sum(kVut) + sub_frame.blur * (b_xx * o.du + b_xy * o.dv);
    const Vec g_dv = scale * (o.q * sum(kVut) + o.r * sum(kVwt)) + sub_frame.blur * (b_xy * o.du + b_yy * o.dv);
    const Vec unfade = opacity / o.determinant;
    const Vec c_xx = b_xx + unfade * o.yy, c_xy = b_xy - unfade * o.xy, c_yy = b_yy + unfade * o.xx;
    Vec d_m0[kMostColumns], d_m1[kMostColumns];
    for (int k = 0; k < kColumns<Bent>; ++k) {
        d_m0[k] = 0.5f * (c_xx * o.m0[k] + c_xy * o.m1[k]);
        d_m1[k] = 0.5f * (c_xy * o.m0[k] + c_yy * o.m1[k]);
    }
    unproject_lanes<Bent>(splats, camera, sub_frame.begin, o.begin, seen, base, into, 0.5f * g_u - g_du,
                          0.5f * g_v - g_dv, d_m0, d_m1, out, pose_begin);
    unproject_lanes<Bent>(splats, camera, sub_frame.end, o.end, seen, base, into, 0.5f * g_u + g_du, 0.5f * g_v + g_dv,
                          d_m0, d_m1, out, pose_end);
}

template <bool Bent>
SPIKED_DEVICE static inline void unproject_moving_by(const Prepared& splats, const PinholeF& camera,
                                                     const SubFrame& sub_frame, int first, const float* sums,
                                                     const uint8_t* visible, int colours, const SplatGradients& out,
                                                     double pose_begin[6], double pose_end[6]) {
    for (int at = 0; at < kGroup; at += kLanes) {
        Int seen;
        for (int i = 0; i < kLanes; ++i) seen[i] = visible[at + i] ? -1 : 0;
        auto sum = [&](int which) { return load(sums + which * kGroup + at); };
        unproject_moving_at<Bent>(splats, camera, sub_frame, first + at, seen, sum, colours, out, pose_begin, pose_end);
    }
}

SPIKED_DEVICE static inline void unproject_moving(const Prepared& splats, const PinholeF& camera,
                                                  const SubFrame& sub_frame, int first, const float* sums,
                                                  const uint8_t* visible, int colours, const SplatGradients& out,
                                                  double pose_begin[6], double pose_end[6]) {
    auto* run = camera.lens ? unproject_moving_by<true> : unproject_moving_by<false>;
    run(splats, camera, sub_frame, first, sums, visible, colours, out, pose_begin, pose_end);
}

}  // namespace
}  // namespace spiked
