// Mean structural similarity and its gradient: plain loops that the compiler vectorises for each instruction set.
// (Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004.)

namespace spiked {
namespace {

// Adds up a row in a fixed order: lanes of floats over at most kRun elements, then doubles.
static double sum_floats(const float* x, int count) {
    constexpr int kRun = 1024;
    double sum = 0;
    for (int from = 0; from < count; from += kRun) {
        const int end = count - from < kRun ? count : from + kRun;
        Vec part{};
        int i = from;
        for (; i + kLanes <= end; i += kLanes) part += load(x + i);
        for (int lane = 0; lane < kLanes; ++lane) sum += part[lane];
        for (; i < end; ++i) sum += x[i];
    }
    return sum;
}

constexpr int kReach = 5;  // the window has 2 kReach + 1 pixels on a side
// exp(-k^2 / (2 1.5^2)), normalised over -5..5
static constexpr float kWindow[kReach + 1] = {0.26601172f, 0.21300553f, 0.10936069f,
                                              0.03600077f, 0.00759876f, 0.00102838f};

// out[x] = the window over in[x - 5 .. x + 5].
static inline void blur_row(const float* __restrict in, int width, float* __restrict out) {
    for (int x = 0; x < width; ++x) {
        float sum = kWindow[0] * in[x];
        for (int k = 1; k <= kReach; ++k) sum += kWindow[k] * (in[x - k] + in[x + k]);
        out[x] = sum;
    }
}

// out[x] = the window over the rows above and below in[x], `stride` apart.
static inline void blur_column(const float* __restrict in, int stride, int width, float* __restrict out) {
    for (int x = 0; x < width; ++x) {
        float sum = kWindow[0] * in[x];
        for (int k = 1; k <= kReach; ++k) sum += kWindow[k] * (in[x - k * stride] + in[x + k * stride]);
        out[x] = sum;
    }
}

// Of one row: similarity, and its derivatives by the blurs of x, x^2 and xy.
static inline void similarity_row(const SsimImage& image, float* const blurred[5], float* __restrict similarity,
                                  float* const d[3]) {
    const float *mean_x = blurred[0], *mean_y = blurred[1], *xx = blurred[2], *yy = blurred[3], *xy = blurred[4];
    float* __restrict d_mean = d[0], * __restrict d_xx = d[1], * __restrict d_xy = d[2];
    for (int x = 0; x < image.width; ++x) {
        const float m = mean_x[x], n = mean_y[x];
        const float a1 = 2 * m * n + image.c1, a2 = 2 * (xy[x] - m * n) + image.c2;
        const float over1 = 1 / (m * m + n * n + image.c1);
        const float over2 = 1 / (xx[x] - m * m + yy[x] - n * n + image.c2);
        const float s = a1 * a2 * over1 * over2;
        similarity[x] = s;
        d_mean[x] = 2 * n * (a2 - a1) * over1 * over2 - 2 * m * s * (over1 - over2);
        d_xx[x] = -s * over2;
        d_xy[x] = 2 * a1 * over1 * over2;
    }
}

static double ssim(const SsimImage& image, const float* rendered, const float* target, float* scratch,
                   float* d_rendered) {
    const int width = image.width, height = image.height;
    const int64_t margin = (int64_t)kReach * width, plane = (int64_t)height * width + 2 * margin;
    float *planes[5], *d_planes[3], *rows[5], *d_rows[3];
    // What is outside the image counts as zero in both images: rows above and below it, and both ends of a row.
    auto take_plane = [&](float*& p) {
        p = scratch + margin;
        scratch += plane;
        __builtin_memset(p - margin, 0, margin * sizeof(float));
        __builtin_memset(p + (int64_t)height * width, 0, margin * sizeof(float));
    };
    auto take_row = [&](float*& p) {
        p = scratch + kReach;
        scratch += width + 2 * kReach;
        __builtin_memset(p - kReach, 0, (width + 2 * kReach) * sizeof(float));
    };
    for (float*& p : planes) take_plane(p);
    for (float*& p : d_planes) take_plane(p);
    for (float*& p : rows) take_row(p);
    for (float*& p : d_rows) take_row(p);

    for (int y = 0; y < height; ++y) {
        const float *a = rendered + (int64_t)y * width, *b = target + (int64_t)y * width;
        for (int x = 0; x < width; ++x) {
            rows[0][x] = a[x];
            rows[1][x] = b[x];
            rows[2][x] = a[x] * a[x];
            rows[3][x] = b[x] * b[x];
            rows[4][x] = a[x] * b[x];
        }
        for (int k = 0; k < 5; ++k) blur_row(rows[k], width, planes[k] + (int64_t)y * width);
    }
    double sum = 0;
    for (int y = 0; y < height; ++y) {
        const int64_t at = (int64_t)y * width;
        for (int k = 0; k < 5; ++k) blur_column(planes[k] + at, width, width, rows[k]);
        // The row of d_rendered holds the similarities until it gets its gradients.
        float* similarity = d_rendered + (int64_t)y * width;
        similarity_row(image, rows, similarity, d_rows);
        sum += sum_floats(similarity, width);
        for (int k = 0; k < 3; ++k) blur_row(d_rows[k], width, d_planes[k] + at);
    }
    const float over = (float)(1.0 / ((double)width * height));
    for (int y = 0; y < height; ++y) {
        const float *a = rendered + (int64_t)y * width, *b = target + (int64_t)y * width;
        float* out = d_rendered + (int64_t)y * width;
        for (int k = 0; k < 3; ++k) blur_column(d_planes[k] + (int64_t)y * width, width, width, d_rows[k]);
        for (int x = 0; x < width; ++x) out[x] = over * (d_rows[0][x] + 2 * a[x] * d_rows[1][x] + b[x] * d_rows[2][x]);
    }
    return sum / ((double)width * height);
}

}  // namespace
}  // namespace spiked
