// Mean structural similarity of two images, on several threads.
#include <algorithm>
#include <vector>

#include "../common/pool.hpp"
#include "bindings.hpp"
#include "buffer.hpp"
#include "kernels.hpp"

namespace spiked {

namespace {

class Similarity {
  public:
    explicit Similarity(int threads) : pool_(threads), scratch_(threads) {}

    double mean(Array<const float, 2> rendered, Array<const float, 2> target, float white, Array<float, 2> d_rendered) {
        const size_t height = rendered.shape(0), width = rendered.shape(1);
        auto fits = [&](const auto& array) { return array.shape(0) == height && array.shape(1) == width; };
        expect(fits(target) && fits(d_rendered), "images disagree");
        expect(height > 0 && width > 0, "images are empty");
        const SsimImage image{static_cast<int>(width), static_cast<int>(height), 1e-4f * white * white,
                              9e-4f * white * white};
        nb::gil_scoped_release release;
        const RasterKernels& kernels = choose_kernels();
        float* planes[8];
        take_planes(width, height, planes);
        sums_.resize(height);
        by_rows(image, [&](int first, int last, float* scratch) {
            kernels.ssim_blur(image, rendered.data(), target.data(), first, last, scratch, planes);
        });
        by_rows(image, [&](int first, int last, float* scratch) {
            kernels.ssim_compare(image, first, last, scratch, planes, sums_.data());
        });
        by_rows(image, [&](int first, int last, float* scratch) {
            kernels.ssim_gradient(image, rendered.data(), target.data(), first, last, scratch, planes,
                                  d_rendered.data());
        });
        double sum = 0;
        for (double row : sums_) sum += row;
        return sum / (static_cast<double>(width) * static_cast<double>(height));
    }

  private:
    // Rows above and below the image count as zero, as those at its sides do.
    void take_planes(size_t width, size_t height, float* planes[8]) {
        const size_t margin = kSsimMargin * width, plane = height * width + 2 * margin;
        float* at = planes_.grow(8 * plane);
        for (int k = 0; k < 8; ++k, at += plane) {
            planes[k] = at + margin;
            std::fill_n(at, margin, 0.0f);
            std::fill_n(at + margin + height * width, margin, 0.0f);
        }
    }

    template <class Work>
    void by_rows(const SsimImage& image, Work work) {
        constexpr int kRows = 16;
        pool_.run((image.height + kRows - 1) / kRows, [&](int task, int thread) {
            work(kRows * task, std::min(image.height, kRows * (task + 1)),
                 scratch_[thread].grow(static_cast<size_t>(ssim_scratch(image.width))));
        });
    }

    Pool pool_;
    Buffer<float> planes_;
    std::vector<Buffer<float>> scratch_;
    std::vector<double> sums_;
};

}  // namespace

void bind_ssim(nb::module_& m) {
    nb::class_<Similarity>(m, "Similarity")
        .def(nb::init<int>(), nb::arg("threads"))
        .def("mean", &Similarity::mean, nb::arg("rendered"), nb::arg("target"), nb::arg("white"),
             nb::arg("d_rendered").noconvert());
}

}  // namespace spiked
