// The rasteriser of a GPU, and its emulation.
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "../raster/binding_passes.hpp"
#include "renderer.hpp"

using namespace spiked;

NB_MODULE(_gpu, m) {
    nb::class_<GpuRenderer> renderer(m, "Renderer");
    bind_passes<GpuRenderer>(renderer);
    m.def(
        "renderer",
        [](double fx, double fy, double cx, double cy, int width, int height, double near, bool emulated,
           const std::optional<Array<const double, 1>>& lens) {
            const PinholeF camera = camera_of(fx, fy, cx, cy, width, height, near, lens);
            return emulated ? emulated_renderer(camera) : cuda_renderer(camera);
        },
        nb::kw_only(), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"), nb::arg("width"), nb::arg("height"),
        nb::arg("near"), nb::arg("emulated"), nb::arg("lens") = nb::none());
    m.def("why_no_cuda", &why_no_cuda);
    m.def("cuda_device", &cuda_device);
    m.attr("architectures") = SPIKED_CUDA_ARCHITECTURES;  // sm_80 and so on, with spaces between; empty without CUDA
}
