// The rasteriser of the CPU.
#include "binding_passes.hpp"

using namespace spiked;

NB_MODULE(_raster, m) {
    bind_adam(m);
    bind_ssim(m);
    nb::class_<Renderer> renderer(m, "Renderer");
    renderer
        .def(
            "__init__",
            [](Renderer* self, double fx, double fy, double cx, double cy, int width, int height, double near,
               int threads, const std::optional<Array<const double, 1>>& lens) {
                new (self) Renderer(camera_of(fx, fy, cx, cy, width, height, near, lens), threads);
            },
            nb::kw_only(), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"), nb::arg("width"),
            nb::arg("height"), nb::arg("near"), nb::arg("threads"), nb::arg("lens") = nb::none())
        .def_prop_ro("threads", &Renderer::threads)
        .def_prop_ro("block_evaluations", &Renderer::block_evaluations);
    bind_passes<Renderer>(renderer);
}
