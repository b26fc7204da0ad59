// The optimiser: bias corrections and steps of Adam, on several threads.
#include <algorithm>
#include <cmath>
#include <vector>

#include "../common/pool.hpp"
#include "bindings.hpp"
#include "kernels.hpp"

namespace nb = nanobind;

namespace spiked {

namespace {

// sqrt(1 - beta2^t) / (1 - beta1^t) for the rows that are seen, 0 for the others; counts their steps.
void adam_corrections(Array<const uint8_t, 1> seen, Array<uint32_t, 1> taken, Array<float, 1> correction, double beta1,
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

    void step(Array<float, 2> parameter, Array<const float, 2> gradient, Array<float, 2> first, Array<float, 2> second,
              Array<const float, 1> correction, float rate, double beta1, double beta2, float epsilon) {
        constexpr size_t kRows = 8192;  // of a task
        const size_t rows = parameter.shape(0), columns = parameter.shape(1);
        auto fits = [&](const auto& array) { return array.shape(0) == rows && array.shape(1) == columns; };
        expect(fits(gradient) && fits(first) && fits(second) && correction.shape(0) == rows, "arrays disagree");
        expect(columns <= 4, "a row has at most four columns");
        const AdamRates rates{rate, static_cast<float>(1 - beta1), static_cast<float>(1 - beta2), epsilon};
        nb::gil_scoped_release release;
        const RasterKernels& kernels = choose_kernels();
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

}  // namespace

void bind_adam(nb::module_& m) {
    m.def("adam_corrections", &adam_corrections, nb::arg("seen"), nb::arg("taken").noconvert(),
          nb::arg("correction").noconvert(), nb::arg("beta1"), nb::arg("beta2"));
    nb::class_<AdamSteps>(m, "AdamSteps")
        .def(nb::init<int>(), nb::arg("threads"))
        .def("step", &AdamSteps::step, nb::arg("parameter").noconvert(), nb::arg("gradient"),
             nb::arg("first").noconvert(), nb::arg("second").noconvert(), nb::arg("correction"), nb::arg("rate"),
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"));
}

}  // namespace spiked
