// One step of Adam: plain loops that the compiler vectorises for each instruction set.
// (D. P. Kingma and J. Ba, "Adam: a method for stochastic optimization", 2015.)

namespace spiked {
namespace {

static void adam(const AdamRates& rates, int rows, int columns, const float* correction, const float* gradient,
                 float* parameter, float* first, float* second) {
    constexpr int kRows = 64, kMaxColumns = 4;
    float step[kRows * kMaxColumns], blend1[kRows * kMaxColumns], blend2[kRows * kMaxColumns];
    for (int row = 0; row < rows; row += kRows) {
        const int count = rows - row < kRows ? rows - row : kRows;
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < columns; ++k) {
                const float c = correction[row + i];
                step[i * columns + k] = rates.rate * c;
                blend1[i * columns + k] = c > 0 ? rates.blend1 : 0;
                blend2[i * columns + k] = c > 0 ? rates.blend2 : 0;
            }
        const int64_t at = (int64_t)row * columns;
        for (int i = 0; i < count * columns; ++i) {
            const float g = gradient[at + i];
            const float m = first[at + i] + blend1[i] * (g - first[at + i]);
            const float v = second[at + i] + blend2[i] * (g * g - second[at + i]);
            first[at + i] = m;
            second[at + i] = v;
            parameter[at + i] -= step[i] * m / (__builtin_sqrtf(v) + rates.epsilon);
        }
    }
}

}  // namespace
}  // namespace spiked
