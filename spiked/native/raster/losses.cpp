#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.hpp"
#include "buffer.hpp"
#include "kernels.hpp"
#include "pool.hpp"

namespace nb = nanobind;

namespace raster {

namespace {

// sqrt(1 - beta2^t) / (1 - beta1^t) for the rows that are seen, 0 for the others; counts their steps.
void adam_corrections(Read<uint8_t, 1> seen, Write<uint32_t, 1> taken, Write<float, 1> correction, double beta1,
                      double beta2) {
    const size_t rows = seen.shape(0);
    expect(taken.shape(0) == rows && correction.shape(0) == rows, "seen, taken and correction have a value a row");
    std::vector<float> known;  // by number of steps
    for (size_t i = 0; i < rows; ++i) {
        if (!seen.data()[i]) {
            correction.data()[i] = 0;
            continue;
        }
        const uint32_t steps = taken.data()[i] + (taken.data()[i] != UINT32_MAX);
        taken.data()[i] = steps;
        if (steps >= known.size()) known.resize(2 * static_cast<size_t>(steps) + 1, -1.0f);
        float& value = known[steps];
        if (value < 0) value = static_cast<float>(std::sqrt(1 - std::pow(beta2, steps)) / (1 - std::pow(beta1, steps)));
        correction.data()[i] = value;
    }
}

class AdamSteps {
  public:
    explicit AdamSteps(int threads) : pool_(threads) {}

    void step(Write<float, 2> parameter, Read<float, 2> gradient, Write<float, 2> first, Write<float, 2> second,
              Read<float, 1> correction, float rate, double beta1, double beta2, float epsilon) {
        constexpr size_t kRows = 8192;  // of a task
        const size_t rows = parameter.shape(0), columns = parameter.shape(1);
        auto fits = [&](const auto& array) { return array.shape(0) == rows && array.shape(1) == columns; };
        expect(fits(gradient) && fits(first) && fits(second) && correction.shape(0) == rows, "arrays disagree");
        expect(columns <= 4, "a row has at most four columns");
        const AdamRates rates{rate, static_cast<float>(1 - beta1), static_cast<float>(1 - beta2), epsilon};
        nb::gil_scoped_release release;
        const Kernels& kernels = choose_kernels();
        pool_.run(static_cast<int>((rows + kRows - 1) / kRows), [&](int task, int) {
            const size_t row = kRows * static_cast<size_t>(task), at = row * columns;
            kernels.adam(rates, static_cast<int>(std::min(kRows, rows - row)), static_cast<int>(columns),
                         correction.data() + row, gradient.data() + at, parameter.data() + at, first.data() + at,
                         second.data() + at);
        });
    }

  private:
    Pool pool_;
};

double robust_loss(ReadAny<float> rendered, ReadAny<float> target, ReadAny<float> weight, bool huber, float scale,
                   WriteAny<float> d_rendered) {
    const size_t count = rendered.size();
    expect(target.size() == count && weight.size() == count && d_rendered.size() == count, "arrays disagree");
    nb::gil_scoped_release release;
    return choose_kernels().robust(huber ? Penalty::kHuber : Penalty::kCharbonnier, scale, static_cast<int64_t>(count),
                                   rendered.data(), target.data(), weight.data(), d_rendered.data());
}

double mean_ssim(Read<float, 2> rendered, Read<float, 2> target, float white, Write<float, 2> d_rendered) {
    const size_t height = rendered.shape(0), width = rendered.shape(1);
    auto fits = [&](const auto& array) { return array.shape(0) == height && array.shape(1) == width; };
    expect(fits(target) && fits(d_rendered), "images disagree");
    expect(height > 0 && width > 0, "images are empty");
    const SsimImage image{static_cast<int>(width), static_cast<int>(height), 1e-4f * white * white,
                          9e-4f * white * white};
    nb::gil_scoped_release release;
    thread_local Buffer<float> scratch;
    return choose_kernels().ssim(image, rendered.data(), target.data(),
                                 scratch.grow(ssim_scratch(image.width, image.height)), d_rendered.data());
}

// Runs independent fused multiply-adds; returns how many single-precision ones.
double multiply_adds(int64_t rounds) {
    nb::gil_scoped_release release;
    const Kernels& kernels = choose_kernels();
    volatile float kept = kernels.multiply_add(rounds);
    static_cast<void>(kept);
    return static_cast<double>(rounds) * kMultiplyAddChains * kernels.lanes;
}

}  // namespace

void bind_losses(nb::module_& m) {
    m.def("adam_corrections", &adam_corrections, nb::arg("seen"), nb::arg("taken"), nb::arg("correction"),
          nb::arg("beta1"), nb::arg("beta2"));
    nb::class_<AdamSteps>(m, "AdamSteps")
        .def(nb::init<int>(), nb::arg("threads"))
        .def("step", &AdamSteps::step, nb::arg("parameter"), nb::arg("gradient"), nb::arg("first"), nb::arg("second"),
             nb::arg("correction"), nb::arg("rate"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"));
    m.def("robust_loss", &robust_loss, nb::arg("rendered"), nb::arg("target"), nb::arg("weight"), nb::arg("huber"),
          nb::arg("scale"), nb::arg("d_rendered"));
    m.def("mean_ssim", &mean_ssim, nb::arg("rendered"), nb::arg("target"), nb::arg("white"), nb::arg("d_rendered"));
    m.def("multiply_adds", &multiply_adds, nb::arg("rounds"));
}

}  // namespace raster
