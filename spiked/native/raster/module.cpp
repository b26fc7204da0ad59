#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include "bindings.hpp"
#include "renderer.hpp"

namespace nb = nanobind;
using namespace raster;

namespace {

Lens lens_of(double fx, double fy, double cx, double cy, int width, int height, double near) {
    expect(width > 0 && height > 0 && width <= kMaxSide && height <= kMaxSide, "image sides are 1 to 4096 pixels");
    Lens lens;
    lens.fx = static_cast<float>(fx), lens.fy = static_cast<float>(fy);
    lens.cx = static_cast<float>(cx), lens.cy = static_cast<float>(cy);
    lens.limit_x = static_cast<float>(1.3 * 0.5 * width / fx);
    lens.limit_y = static_cast<float>(1.3 * 0.5 * height / fy);
    lens.near = static_cast<float>(near);
    lens.width = width, lens.height = height;
    lens.tiles_x = (width + kTile - 1) / kTile, lens.tiles_y = (height + kTile - 1) / kTile;
    return lens;
}

void forward(Renderer& self, Read<float, 2> means, Read<float, 2> quats, Read<float, 2> log_scales,
             Read<float, 1> opacity_logits, Read<float, 2> colours, Read<double, 3> rotations, Read<double, 2> centres,
             std::optional<Read<float, 3>> weights, std::optional<Read<float, 3>> windows,
             std::optional<Read<uint8_t, 2>> channels, Read<float, 1> background, WriteAny<float> values,
             Write<float, 2> alpha, Write<float, 2> depth) {
    const size_t n = means.shape(0), s = rotations.shape(0), c = colours.shape(1);
    const size_t height = self.lens().height, width = self.lens().width;
    expect(means.shape(1) == 3 && quats.shape(0) == n && quats.shape(1) == 4 && log_scales.shape(0) == n &&
               log_scales.shape(1) == 3 && opacity_logits.shape(0) == n && colours.shape(0) == n,
           "splat arrays disagree");
    expect(c == 1 || c == 3, "colours are [N, 1] or [N, 3]");
    expect(n < (1u << 27), "too many splats");
    expect(s > 0 && rotations.shape(1) == 3 && rotations.shape(2) == 3 && centres.shape(0) == s &&
               centres.shape(1) == 3 && background.shape(0) == 3,
           "poses disagree");
    expect(!weights || (weights->shape(0) == s && weights->shape(1) == height && weights->shape(2) == width),
           "weights are [S, H, W]");
    expect(!windows || (!weights && s > 1 && windows->shape(0) == 2 && windows->shape(1) == height &&
                        windows->shape(2) == width),
           "windows are [2, H, W], go without weights, and need two poses");
    expect(!channels || (c == 3 && channels->shape(0) == height && channels->shape(1) == width),
           "channels are [H, W], for splats of three colours");
    expect(values.size() == height * width * (channels ? 1 : c) && alpha.size() == height * width &&
               depth.size() == height * width,
           "outputs have the wrong size");
    const SplatArrays splats{static_cast<int>(n), static_cast<int>(c),   means.data(),  quats.data(),
                             log_scales.data(),   opacity_logits.data(), colours.data()};
    const Views views{rotations.data(),
                      centres.data(),
                      static_cast<int>(s),
                      weights ? weights->data() : nullptr,
                      windows ? windows->data() : nullptr,
                      windows ? windows->data() + height * width : nullptr,
                      channels ? channels->data() : nullptr};
    nb::gil_scoped_release release;
    self.forward(splats, views, background.data(), values.data(), alpha.data(), depth.data());
}

void backward(Renderer& self, ReadAny<float> d_values, Write<float, 2> means, Write<float, 2> quats,
              Write<float, 2> log_scales, Write<float, 1> opacity_logits, Write<float, 2> colours,
              Write<double, 2> rotation, Write<double, 2> centre, Write<float, 1> contribution,
              Write<float, 1> radius_px) {
    expect(self.poses() > 0, "backward follows forward");
    const size_t n = self.splats().count, s = self.poses(), c = self.splats().colours;
    const size_t pixels = static_cast<size_t>(self.lens().height) * self.lens().width;
    expect(d_values.size() == pixels * (self.mosaic() ? 1 : c), "d_values has the wrong size");
    expect(means.size() == 3 * n && quats.size() == 4 * n && log_scales.size() == 3 * n && opacity_logits.size() == n &&
               colours.size() == c * n && rotation.size() == 3 * s && centre.size() == 3 * s &&
               contribution.size() == n && radius_px.size() == n,
           "outputs have the wrong size");
    const GradientArrays out{means.data(),    quats.data(),  log_scales.data(),   opacity_logits.data(), colours.data(),
                             rotation.data(), centre.data(), contribution.data(), radius_px.data()};
    nb::gil_scoped_release release;
    self.backward(d_values.data(), out);
}

}  // namespace

NB_MODULE(_raster, m) {
    bind_losses(m);
    bind_charge(m);
    nb::class_<Renderer>(m, "Renderer")
        .def(
            "__init__",
            [](Renderer* self, double fx, double fy, double cx, double cy, int width, int height, double near,
               int threads) { new (self) Renderer(lens_of(fx, fy, cx, cy, width, height, near), threads); },
            nb::kw_only(), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"), nb::arg("cy"), nb::arg("width"),
            nb::arg("height"), nb::arg("near"), nb::arg("threads"))
        .def("forward", &forward, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("opacity_logits"),
             nb::arg("colours"), nb::arg("rotations"), nb::arg("centres"), nb::arg("weights").none(),
             nb::arg("windows").none(), nb::arg("channels").none(), nb::arg("background"), nb::arg("values"),
             nb::arg("alpha"), nb::arg("depth"))
        .def("backward", &backward, nb::arg("d_values"), nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"),
             nb::arg("opacity_logits"), nb::arg("colours"), nb::arg("rotation"), nb::arg("centre"),
             nb::arg("contribution"), nb::arg("radius_px"))
        .def_prop_ro("instructions", &Renderer::instructions)
        .def_prop_ro("threads", &Renderer::threads)
        .def_prop_ro("block_evaluations", &Renderer::block_evaluations);
}
