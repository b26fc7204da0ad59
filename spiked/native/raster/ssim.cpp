// Mean structural similarity of two images.
#include "bindings.hpp"
#include "buffer.hpp"
#include "kernels.hpp"

namespace spiked {

namespace {

double mean_ssim(Array<const float, 2> rendered, Array<const float, 2> target, float white,
                 Array<float, 2> d_rendered) {
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

}  // namespace

void bind_ssim(nb::module_& m) {
    m.def("mean_ssim", &mean_ssim, nb::arg("rendered"), nb::arg("target"), nb::arg("white"),
          nb::arg("d_rendered").noconvert());
}

}  // namespace spiked
