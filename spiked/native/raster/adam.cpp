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
        const size_t rows = parameter.shape(0), columns = parameter.shape(1);
        auto fits = [&](const auto& array) { return array.shape(0) == rows && array.shape(1) == columns; };
        expect(fits(gradient) && fits(first) && fits(second) && correction.shape(0) == rows, "arrays disagree");
        expect(columns <= 4, "a row has at most four columns");
        const AdamRates rates{rate, static_cast<float>(1 - beta1), static_cast<float>(1 - beta2), epsilon};
        nb::gil_scoped_release release;
        const RasterKernels& kernels = choose_kernels();
        run(rows, [&](size_t row, size_t last) {
            const size_t at = row * columns;
            kernels.adam(rates, static_cast<int>(last - row), static_cast<int>(columns), correction.data() + row,
                         gradient.data() + at, parameter.data() + at, first.data() + at, second.data() + at);
        });
    }

    void slopes_along_axes(Array<const float, 2> quats, Array<const float, 2> log_scales, float blur, bool own,
                           Array<const float, 2> by_means, Array<float, 2> by_axes) {
        along_axes(quats, log_scales, blur, own, by_means, by_axes, choose_kernels().slopes_along_axes);
    }

    void move_along_axes(Array<const float, 2> quats, Array<const float, 2> log_scales, float blur, bool own,
                         Array<const float, 2> steps, Array<float, 2> means) {
        along_axes(quats, log_scales, blur, own, steps, means, choose_kernels().move_along_axes);
    }

  private:
    static constexpr size_t kRows = 8192;  // of a task

    template <class Kernel>
    void along_axes(const Array<const float, 2>& quats, const Array<const float, 2>& log_scales, float blur, bool own,
                    const Array<const float, 2>& from, const Array<float, 2>& to, Kernel kernel) {
        const size_t rows = quats.shape(0);
        auto fits = [&](const auto& array) { return array.shape(0) == rows && array.shape(1) == 3; };
        expect(quats.shape(1) == 4 && fits(log_scales) && fits(from) && fits(to), "arrays disagree");
        const SplatAxes splats{quats.data(), log_scales.data(), blur, own};
        nb::gil_scoped_release release;
        run(rows, [&](size_t first, size_t last) {
            kernel(splats, static_cast<int>(first), static_cast<int>(last), from.data(), to.data());
        });
    }

    // Calls task(first, last) for all rows, on several threads.
    template <class Task>
    void run(size_t rows, Task task) {
        pool_.run(static_cast<int>((rows + kRows - 1) / kRows),
                  [&](int number, int) { task(number * kRows, std::min(rows, (number + 1) * kRows)); });
    }

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
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"))
        .def("slopes_along_axes", &AdamSteps::slopes_along_axes, nb::arg("quats"), nb::arg("log_scales"),
             nb::arg("blur"), nb::arg("own"), nb::arg("by_means"), nb::arg("by_axes").noconvert())
        .def("move_along_axes", &AdamSteps::move_along_axes, nb::arg("quats"), nb::arg("log_scales"), nb::arg("blur"),
             nb::arg("own"), nb::arg("steps"), nb::arg("means").noconvert());
}

}  // namespace spiked
