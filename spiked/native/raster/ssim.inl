// Mean structural similarity and its gradient: plain loops that the compiler vectorises for each instruction set.

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

// out[x] = the window over in[x - 5 .. x + 5].
static inline void blur_row(const float* __restrict in, int width, float* __restrict out) {
    for (int x = 0; x < width; ++x) out[x] = windowed(in + x, 1);
}

// out[x] = the window over the rows above and below in[x], `stride` apart.
static inline void blur_column(const float* __restrict in, int stride, int width, float* __restrict out) {
    for (int x = 0; x < width; ++x) out[x] = windowed(in + x, stride);
}

// Of one row: similarity, and its derivatives by the blurs of x, x^2 and xy.
static inline void similarity_row(const SsimImage& image, float* const blurred[5], float* __restrict similarity,
                                  float* const d[3]) {
    const float *mean_x = blurred[0], *mean_y = blurred[1], *xx = blurred[2], *yy = blurred[3], *xy = blurred[4];
    float* __restrict d_mean = d[0], * __restrict d_xx = d[1], * __restrict d_xy = d[2];
    for (int x = 0; x < image.width; ++x) {
        const Similar at = similar(image, mean_x[x], mean_y[x], xx[x], yy[x], xy[x]);
        similarity[x] = at.value;
        d_mean[x] = at.by_mean;
        d_xx[x] = at.by_xx;
        d_xy[x] = at.by_xy;
    }
}

// Rows of scratch [8][width] with margins of zeros at both ends: what is outside of the image counts as zero.
static inline void take_rows(float* scratch, int width, float* rows[8]) {
    for (int k = 0; k < 8; ++k, scratch += width + 2 * kReach) {
        rows[k] = scratch + kReach;
        __builtin_memset(scratch, 0, (width + 2 * kReach) * sizeof(float));
    }
}

// Blurs rows [first, last) of x, y, x^2, y^2 and xy along themselves.
static void ssim_blur(const SsimImage& image, const float* rendered, const float* target, int first, int last,
                      float* scratch, float* const planes[8]) {
    const int width = image.width;
    float* rows[8];
    take_rows(scratch, width, rows);
    for (int y = first; y < last; ++y) {
        const int64_t at = (int64_t)y * width;
        const float *a = rendered + at, *b = target + at;
        for (int x = 0; x < width; ++x) {
            rows[0][x] = a[x];
            rows[1][x] = b[x];
            rows[2][x] = a[x] * a[x];
            rows[3][x] = b[x] * b[x];
            rows[4][x] = a[x] * b[x];
        }
        for (int k = 0; k < 5; ++k) blur_row(rows[k], width, planes[k] + at);
    }
}

// The similarity of rows [first, last), a sum for each, and its derivatives blurred along the rows.
static void ssim_compare(const SsimImage& image, int first, int last, float* scratch, float* const planes[8],
                         double* sums) {
    const int width = image.width;
    float* rows[8];
    take_rows(scratch, width, rows);
    float* const* d_rows = rows + 4;  // rows[0..3] hold the similarities and blurs in turn
    float* blurred = scratch + 8 * (width + 2 * kReach);
    float* means[5];
    for (int k = 0; k < 5; ++k) means[k] = blurred + (int64_t)k * width;
    for (int y = first; y < last; ++y) {
        const int64_t at = (int64_t)y * width;
        for (int k = 0; k < 5; ++k) blur_column(planes[k] + at, width, width, means[k]);
        similarity_row(image, means, rows[0], d_rows);
        sums[y] = sum_floats(rows[0], width);
        for (int k = 0; k < 3; ++k) blur_row(d_rows[k], width, planes[5 + k] + at);
    }
}

// The gradient of the mean similarity by rows [first, last) of the rendered image.
static void ssim_gradient(const SsimImage& image, const float* rendered, const float* target, int first, int last,
                          float* scratch, float* const planes[8], float* d_rendered) {
    const int width = image.width;
    const float over = (float)(1.0 / ((double)width * image.height));
    float* d_rows[3] = {scratch, scratch + width, scratch + 2 * width};
    for (int y = first; y < last; ++y) {
        const int64_t at = (int64_t)y * width;
        const float *a = rendered + at, *b = target + at;
        float* out = d_rendered + at;
        for (int k = 0; k < 3; ++k) blur_column(planes[5 + k] + at, width, width, d_rows[k]);
        for (int x = 0; x < width; ++x)
            out[x] = over * by_rendered(a[x], b[x], d_rows[0][x], d_rows[1][x], d_rows[2][x]);
    }
}

}  // namespace
}  // namespace spiked
