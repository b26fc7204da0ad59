// Structural similarity at one pixel and the window that its moments are taken over; a GPU's threads run the same lines
// (native/gpu). (Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004.)

namespace spiked {
namespace {

constexpr int kReach = kSsimMargin;  // the window has 2 kReach + 1 pixels on a side

// The window's weights of pixels 0 to 5 from the middle: exp(-k^2 / (2 1.5^2)), normalised over -5..5.
constexpr float kWindow0 = 0.26601172f, kWindow1 = 0.21300553f, kWindow2 = 0.10936069f;
constexpr float kWindow3 = 0.03600077f, kWindow4 = 0.00759876f, kWindow5 = 0.00102838f;

// The window over in[-kReach stride .. kReach stride]. Written out, so that loops around it are vectorised.
SPIKED_DEVICE SPIKED_INLINED static inline float windowed(const float* in, int stride) {
    float sum = kWindow0 * in[0];
    sum += kWindow1 * (in[-stride] + in[stride]);
    sum += kWindow2 * (in[-2 * stride] + in[2 * stride]);
    sum += kWindow3 * (in[-3 * stride] + in[3 * stride]);
    sum += kWindow4 * (in[-4 * stride] + in[4 * stride]);
    sum += kWindow5 * (in[-5 * stride] + in[5 * stride]);
    return sum;
}

// The similarity at a pixel, and its derivatives by the windowed x, x^2 and xy.
struct Similar {
    float value, by_mean, by_xx, by_xy;
};

// From the windowed x, y, x^2, y^2 and xy.
SPIKED_DEVICE SPIKED_INLINED static inline Similar similar(const SsimImage& image, float m, float n, float xx, float yy,
                                                           float xy) {
    const float a1 = 2 * m * n + image.c1, a2 = 2 * (xy - m * n) + image.c2;
    const float over1 = 1 / (m * m + n * n + image.c1);
    const float over2 = 1 / (xx - m * m + yy - n * n + image.c2);
    const float s = a1 * a2 * over1 * over2;
    return {s, 2 * n * (a2 - a1) * over1 * over2 - 2 * m * s * (over1 - over2), -s * over2, 2 * a1 * over1 * over2};
}

// The derivative of the similarities around a pixel by its x, from their windowed derivatives.
SPIKED_DEVICE SPIKED_INLINED static inline float by_rendered(float x, float y, float by_mean, float by_xx,
                                                             float by_xy) {
    return by_mean + 2 * x * by_xx + y * by_xy;
}

}  // namespace
}  // namespace spiked
