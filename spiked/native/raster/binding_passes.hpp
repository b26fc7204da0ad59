// What the Python faces of the renderers share, on the CPU and on a GPU: the shapes of their arguments are checked
// here.
#pragma once
#include <algorithm>
#include <cmath>

#include "../geometry/lens.hpp"
#include "bindings.hpp"
#include "renderer.hpp"

namespace spiked {

namespace {

// The projection's Jacobian is taken at x/z and y/z clamped to this multiple of the half field of view, as in the
// published code of 3D Gaussian splatting (Kerbl et al. 2023): beyond, its linearisation of the projection diverges.
constexpr double kSlopeLimit = 1.3;

// Limits the slopes of a lens to what its image shows: all pixels on the border are straightened.
void set_lens(PinholeF& camera, double fx, double fy, double cx, double cy, const Lens& lens) {
    camera.lens = lens.model;
    for (int i = 0; i < 5; ++i) camera.coefficients[i] = static_cast<float>(lens.k[i]);
    double across = 0, down = 0, farthest = 0;
    const int around = 2 * (camera.width + camera.height);
    for (int i = 0; i < around; ++i) {
        const int j = i / 2;
        const bool level = j < camera.width;
        double x = ((level ? j : i % 2 * camera.width) - cx) / fx;
        double y = ((level ? i % 2 * camera.height : j - camera.width) - cy) / fy;
        straighten(lens, x, y);
        across = std::max(across, std::abs(x)), down = std::max(down, std::abs(y));
        farthest = std::max(farthest, x * x + y * y);
    }
    camera.limit_x = static_cast<float>(kSlopeLimit * across);
    camera.limit_y = static_cast<float>(kSlopeLimit * down);
    camera.reach2 = static_cast<float>(std::min(lens.reach2, kSlopeLimit * kSlopeLimit * farthest));
}

PinholeF camera_of(double fx, double fy, double cx, double cy, int width, int height, double near,
                   const std::optional<Array<const double, 1>>& given) {
    expect(width > 0 && height > 0 && width <= kMaxSide && height <= kMaxSide, "image sides are 1 to 4096 pixels");
    PinholeF camera{};
    camera.fx = static_cast<float>(fx), camera.fy = static_cast<float>(fy);
    camera.cx = static_cast<float>(cx), camera.cy = static_cast<float>(cy);
    camera.limit_x = static_cast<float>(kSlopeLimit * 0.5 * width / fx);
    camera.limit_y = static_cast<float>(kSlopeLimit * 0.5 * height / fy);
    camera.near = static_cast<float>(near);
    camera.width = width, camera.height = height;
    camera.tiles_x = (width + kTile - 1) / kTile, camera.tiles_y = (height + kTile - 1) / kTile;
    if (given) set_lens(camera, fx, fy, cx, cy, lens_of(given));
    return camera;
}

inline void expect_poses(const Array<const double, 3>& rotations, const Array<const double, 2>& centres,
                         const Array<const float, 1>& background) {
    const size_t s = rotations.shape(0);
    expect(s > 0 && rotations.shape(1) == 3 && rotations.shape(2) == 3 && centres.shape(0) == s &&
               centres.shape(1) == 3 && background.shape(0) == 3,
           "poses disagree");
}

// Poses, planes and images of a forward pass, as Python gives them.
struct PassArrays {
    const Array<const double, 3>& rotations;
    const Array<const double, 2>& centres;
    const std::optional<Array<const float, 3>>&weights, &windows;
    const std::optional<Array<const uint8_t, 2>>& channels;
    const Array<const float, 1>& background;
    const AnyArray<float>& values;
    const Array<float, 2>&alpha, &depth;

    // Checks them against the camera and the number of colours.
    Views views(const PinholeF& camera, size_t c) const {
        const size_t s = rotations.shape(0), height = camera.height, width = camera.width;
        expect_poses(rotations, centres, background);
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
        return {rotations.data(),
                centres.data(),
                static_cast<int>(s),
                weights ? weights->data() : nullptr,
                windows ? windows->data() : nullptr,
                windows ? windows->data() + height * width : nullptr,
                channels ? channels->data() : nullptr};
    }
};

// T: float or const float.
template <class T>
SplatArrays splats_of(const Array<T, 2>& means, const Array<T, 2>& quats, const Array<T, 2>& log_scales,
                      const Array<T, 1>& opacity_logits, const Array<T, 2>& colours) {
    const size_t n = means.shape(0), c = colours.shape(1);
    expect(means.shape(1) == 3 && quats.shape(0) == n && quats.shape(1) == 4 && log_scales.shape(0) == n &&
               log_scales.shape(1) == 3 && opacity_logits.shape(0) == n && colours.shape(0) == n,
           "splat arrays disagree");
    expect(c == 1 || c == 3, "colours are [N, 1] or [N, 3]");
    expect(n < (1u << 27), "too many splats");
    return {static_cast<int>(n), static_cast<int>(c),   means.data(),  quats.data(),
            log_scales.data(),   opacity_logits.data(), colours.data()};
}

template <class Renderer>
void forward(Renderer& self, Array<const float, 2> means, Array<const float, 2> quats, Array<const float, 2> log_scales,
             Array<const float, 1> opacity_logits, Array<const float, 2> colours, Array<const double, 3> rotations,
             Array<const double, 2> centres, std::optional<Array<const float, 3>> weights,
             std::optional<Array<const float, 3>> windows, std::optional<Array<const uint8_t, 2>> channels,
             Array<const float, 1> background, AnyArray<float> values, Array<float, 2> alpha, Array<float, 2> depth) {
    const SplatArrays splats = splats_of(means, quats, log_scales, opacity_logits, colours);
    const PassArrays arrays{rotations, centres, weights, windows, channels, background, values, alpha, depth};
    const Views views = arrays.views(self.camera(), colours.shape(1));
    nb::gil_scoped_release release;
    self.forward(splats, views, background.data(), values.data(), alpha.data(), depth.data());
}

template <class Renderer>
void backward(Renderer& self, AnyArray<const float> d_values, Array<float, 2> means, Array<float, 2> quats,
              Array<float, 2> log_scales, Array<float, 1> opacity_logits, Array<float, 2> colours,
              Array<double, 2> rotation, Array<double, 2> centre, Array<float, 1> contribution,
              Array<float, 1> radius_px) {
    expect(self.poses() > 0, "backward follows forward");
    const size_t n = self.splats().count, s = self.poses(), c = self.splats().colours;
    const size_t pixels = static_cast<size_t>(self.camera().height) * self.camera().width;
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

// forward() and backward() of the class of a renderer.
template <class Renderer, class Class>
void bind_passes(Class& bound) {
    bound
        .def("forward", &forward<Renderer>, nb::arg("means").noconvert(), nb::arg("quats").noconvert(),
             nb::arg("log_scales").noconvert(), nb::arg("opacity_logits").noconvert(), nb::arg("colours").noconvert(),
             nb::arg("rotations").noconvert(), nb::arg("centres").noconvert(), nb::arg("weights").none().noconvert(),
             nb::arg("windows").none().noconvert(), nb::arg("channels").none().noconvert(), nb::arg("background"),
             nb::arg("values").noconvert(), nb::arg("alpha").noconvert(), nb::arg("depth").noconvert())
        .def("backward", &backward<Renderer>, nb::arg("d_values"), nb::arg("means").noconvert(),
             nb::arg("quats").noconvert(), nb::arg("log_scales").noconvert(), nb::arg("opacity_logits").noconvert(),
             nb::arg("colours").noconvert(), nb::arg("rotation").noconvert(), nb::arg("centre").noconvert(),
             nb::arg("contribution").noconvert(), nb::arg("radius_px").noconvert())
        .def_prop_ro("instructions", &Renderer::instructions);
}

}  // namespace

}  // namespace spiked
