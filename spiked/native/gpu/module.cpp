// The rasteriser of a GPU, and its emulation.
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "../charge/limits.hpp"
#include "../raster/binding_passes.hpp"
#include "renderer.hpp"

using namespace spiked;

namespace {

void forward_scene(GpuRenderer& self, GpuScene& scene, Array<const double, 3> rotations, Array<const double, 2> centres,
                   std::optional<Array<const float, 3>> weights, std::optional<Array<const float, 3>> windows,
                   std::optional<Array<const uint8_t, 2>> channels, Array<const float, 1> background,
                   AnyArray<float> values, Array<float, 2> alpha, Array<float, 2> depth) {
    const PassArrays arrays{rotations, centres, weights, windows, channels, background, values, alpha, depth};
    const Views views = arrays.views(self.camera(), scene.colours());
    nb::gil_scoped_release release;
    self.forward(scene, views, background.data(), values.data(), alpha.data(), depth.data());
}

size_t pixels_of(const GpuRenderer& self) { return static_cast<size_t>(self.camera().height) * self.camera().width; }

template <class T>
void expect_plane(const GpuRenderer& self, const Array<T, 2>& plane) {
    expect(plane.shape(0) == static_cast<size_t>(self.camera().height) &&
               plane.shape(1) == static_cast<size_t>(self.camera().width),
           "a plane has another size than the images");
}

std::unique_ptr<GpuFrame> frame(GpuRenderer& self, AnyArray<const float> rates, AnyArray<const float> deviation,
                                std::optional<Array<const float, 3>> windows,
                                std::optional<Array<const uint8_t, 2>> channels) {
    const size_t height = self.camera().height, width = self.camera().width, values = rates.size();
    expect((values == height * width || (values == 3 * height * width && !channels)) && deviation.size() == values,
           "rates and deviations are [H, W] or [H, W, 3]");
    expect(!windows || (windows->shape(0) == 2 && windows->shape(1) == height && windows->shape(2) == width),
           "windows are [2, H, W]");
    if (channels) expect_plane(self, *channels);
    nb::gil_scoped_release release;
    return self.frame({values, rates.data(), deviation.data(), windows ? windows->data() : nullptr,
                       channels ? channels->data() : nullptr});
}

void expect_alike(const GpuRenderer& self, const GpuFrame& frame) {
    expect(frame.width == self.camera().width && frame.height == self.camera().height, "the frame has another size");
}

nb::tuple compare(GpuRenderer& self, GpuScene& scene, GpuFrame& frame, Array<const double, 3> rotations,
                  Array<const double, 2> centres, Array<const float, 1> background, float white, float floor,
                  float share, float scale, std::optional<float> level, float model_error, float sigmas) {
    expect_poses(rotations, centres, background);
    const size_t poses = rotations.shape(0), pixels = pixels_of(self);
    expect_alike(self, frame);
    expect(!frame.moving || poses > 1, "windows need two poses");
    expect(frame.values == pixels * (frame.mosaic ? 1 : scene.colours()) && (!frame.mosaic || scene.colours() == 3),
           "the frame has other colours than the scene");
    expect(white > 0, "white is not positive");
    expect(!level || (self.has_gains() && frame.values == pixels),
           "gains are set first, for frames of one value a pixel");
    const Views views{rotations.data(), centres.data(), static_cast<int>(poses), nullptr, nullptr, nullptr, nullptr};
    const RateLoss loss{white, floor, share, scale, level.has_value(), level.value_or(1.0f), model_error, sigmas};
    RateComparison made;
    {
        nb::gil_scoped_release release;
        made = self.compare(scene, frame, views, background.data(), loss);
    }
    return nb::make_tuple(made.error, made.similarity, made.expected_light, made.seen_light);
}

std::unique_ptr<GpuSpikes> spikes(GpuRenderer& self, Array<const uint8_t, 2> bytes, int width, int height,
                                  int row_stride, bool flipped, bool msb, Array<const uint8_t, 1> tile) {
    expect(
        width > 0 && width % 8 == 0 && height > 0 && height <= kMaxSide && width <= kMaxSide && row_stride >= width / 8,
        "a row is whole bytes and fits its stride");
    expect(bytes.shape(0) > 0 && bytes.shape(0) <= kMaxChargeFrames &&
               bytes.shape(1) == static_cast<size_t>(row_stride) * height,
           "frames are uint8 [n, row_stride * height], at most 64");
    expect(tile.shape(0) == 4 && *std::max_element(tile.data(), tile.data() + 4) < 3, "a tile is four of 0, 1, 2");
    SpikeLayout layout{width, height, row_stride, flipped, msb, {}};
    std::copy_n(tile.data(), 4, layout.tile);
    nb::gil_scoped_release release;
    return self.spikes(layout, bytes.data(), static_cast<int>(bytes.shape(0)));
}

std::unique_ptr<GpuLight> light(GpuRenderer& self, Array<const float, 2> gain,
                                std::optional<Array<const float, 2>> dark) {
    expect(gain.size() > 0 && (!dark || (dark->shape(0) == gain.shape(0) && dark->shape(1) == gain.shape(1))),
           "gain and dark are [H, W]");
    nb::gil_scoped_release release;
    return self.light(static_cast<int>(gain.shape(1)), static_cast<int>(gain.shape(0)), gain.data(),
                      dark ? dark->data() : nullptr);
}

nb::tuple compare_charge(GpuRenderer& self, GpuScene& scene, GpuSpikes& spikes, GpuLight& light,
                         Array<const double, 3> rotations, Array<const double, 2> centres,
                         Array<const float, 1> background, Array<const float, 3> turn, Array<const float, 2> shift,
                         int cell, float nearest, float pixel, int every, int phase, float level, float floor,
                         float jitter, float white, float detail, Array<const float, 1> window) {
    expect_poses(rotations, centres, background);
    const size_t frames = spikes.frames;
    const PinholeF& camera = self.camera();
    expect(rotations.shape(0) == 1, "an image is compared with spikes from one pose");
    expect(turn.shape(0) == frames && turn.shape(1) == 3 && turn.shape(2) == 3 && shift.shape(0) == frames &&
               shift.shape(1) == 3,
           "turn [n, 3, 3] and shift [n, 3] are of the frames");
    expect(light.width == spikes.layout.width && light.height == spikes.layout.height,
           "gain and dark have the sensor's size");
    expect(camera.width > 1 && camera.height > 1 && camera.lens == 0, "the image is at least 2x2, without distortion");
    expect(cell > 0 && pixel >= 1 && nearest > 0, "cell, pixel and nearest are positive");
    expect(every > 0 && phase >= 0 && phase < every, "phase is one of every");
    expect(floor > 0 && jitter > 0 && white > 0, "floor, jitter and white are positive");
    expect(window.shape(0) == kDetailReach + 1, "the window has seven weights");
    ChargeLoss loss{turn.data(), shift.data(),        cell,   nearest, pixel, every, phase, level, floor,
                    jitter,      1 / (white * white), detail, {}};
    std::copy_n(window.data(), kDetailReach + 1, loss.window);
    const Views pose{rotations.data(), centres.data(), 1, nullptr, nullptr, nullptr, nullptr};
    ChargeComparison made;
    {
        nb::gil_scoped_release release;
        made = self.compare_charge(scene, spikes, light, pose, background.data(), loss);
    }
    return nb::make_tuple(made.loss, made.pixels, made.chi2, made.intervals, made.expected, made.counted);
}

void charge_slope(GpuRenderer& self, AnyArray<float> out) {
    expect(self.charge_values() > 0 && out.size() == self.charge_values(),
           "no image was compared with spikes, or the output has another size");
    nb::gil_scoped_release release;
    self.charge_slope(out.data());
}

void set_gains(GpuRenderer& self, Array<const float, 2> gain) {
    expect_plane(self, gain);
    nb::gil_scoped_release release;
    self.set_gains(gain.data());
}

void slope(GpuRenderer& self, AnyArray<float> out) {
    expect(self.compared(), "the last image was not compared");
    expect(out.size() == pixels_of(self) * (self.mosaic() ? 1 : self.splats().colours),
           "the output has the wrong size");
    nb::gil_scoped_release release;
    self.slope(out.data());
}

void add_evidence(GpuRenderer& self, GpuFrame& frame, float level, float model_error) {
    expect(self.compared() && self.has_gains(), "the last image was not compared");
    expect(self.has_evidence(), "there is no evidence to add to");
    expect_alike(self, frame);
    expect(frame.values == pixels_of(self), "gains are of frames of one value a pixel");
    nb::gil_scoped_release release;
    self.add_evidence(frame, level, model_error);
}

void set_evidence(GpuRenderer& self, Array<const float, 2> xx, Array<const float, 2> xy) {
    expect_plane(self, xx);
    expect_plane(self, xy);
    nb::gil_scoped_release release;
    self.set_evidence(xx.data(), xy.data());
}

void evidence(GpuRenderer& self, Array<float, 2> xx, Array<float, 2> xy) {
    expect(self.has_evidence(), "there is no evidence");
    expect_plane(self, xx);
    expect_plane(self, xy);
    nb::gil_scoped_release release;
    self.evidence(xx.data(), xy.data());
}

void descend(GpuRenderer& self, std::optional<AnyArray<const float>> d_values, GpuScene& scene,
             Array<const float, 1> rates, float blur, bool own_axes, float beta1, float beta2, float epsilon,
             float most_log_scale, float widest, Array<const float, 1> centre) {
    expect(self.poses() > 0, "backward follows forward");
    expect(d_values ? d_values->size() == pixels_of(self) * (self.mosaic() ? 1 : scene.colours()) : self.compared(),
           "d_values has the wrong size, or the last image was not compared");
    expect(self.splats().count == scene.count() && self.splats().colours == scene.colours(),
           "the last image is of another scene");
    expect(rates.shape(0) == 5, "a rate for each of the five arrays");
    expect(centre.shape(0) == 3, "a centre has three coordinates");
    const float *r = rates.data(), *c = centre.data();
    const DescentRates given{{r[0], r[1], r[2], r[3], r[4]},
                             blur,
                             own_axes,
                             beta1,
                             beta2,
                             epsilon,
                             most_log_scale,
                             widest,
                             {c[0], c[1], c[2]}};
    nb::gil_scoped_release release;
    self.descend(d_values ? d_values->data() : nullptr, scene, given);
}

void set_scene(GpuScene& self, Array<const float, 2> means, Array<const float, 2> quats,
               Array<const float, 2> log_scales, Array<const float, 1> opacity_logits, Array<const float, 2> colours,
               Array<const float, 2> first, Array<const float, 2> second, Array<const uint32_t, 1> taken) {
    const SplatArrays splats = splats_of(means, quats, log_scales, opacity_logits, colours);
    const size_t moments = static_cast<size_t>(splats.count) * (11 + splats.colours);
    expect(first.size() == moments && second.size() == moments && taken.size() == means.shape(0), "moments disagree");
    nb::gil_scoped_release release;
    self.set(splats, first.data(), second.data(), taken.data());
}

void get_scene(GpuScene& self, Array<float, 2> means, Array<float, 2> quats, Array<float, 2> log_scales,
               Array<float, 1> opacity_logits, Array<float, 2> colours, Array<float, 2> first, Array<float, 2> second,
               Array<uint32_t, 1> taken) {
    const SplatArrays splats = splats_of(means, quats, log_scales, opacity_logits, colours);
    const size_t moments = static_cast<size_t>(splats.count) * (11 + splats.colours);
    expect(splats.count == self.count() && splats.colours == self.colours() && first.size() == moments &&
               second.size() == moments && taken.size() == means.shape(0),
           "the scene has another size");
    nb::gil_scoped_release release;
    self.get(means.data(), quats.data(), log_scales.data(), opacity_logits.data(), colours.data(), first.data(),
             second.data(), taken.data());
}

void select_rows(GpuScene& self, Array<const uint32_t, 1> rows) {
    for (size_t i = 0; i < rows.shape(0); ++i)
        expect(rows.data()[i] < static_cast<uint32_t>(self.count()), "there is no such row");
    nb::gil_scoped_release release;
    self.select(rows.data(), rows.shape(0));
}

void join_splats(GpuScene& self, Array<const float, 2> means, Array<const float, 2> quats,
                 Array<const float, 2> log_scales, Array<const float, 1> opacity_logits,
                 Array<const float, 2> colours) {
    const SplatArrays splats = splats_of(means, quats, log_scales, opacity_logits, colours);
    expect(splats.colours == self.colours(), "the scene has other colours");
    expect(self.count() + means.shape(0) < (1u << 27), "too many splats");
    nb::gil_scoped_release release;
    self.join(splats);
}

void opacity_logits(GpuScene& self, Array<float, 1> out) {
    expect(out.shape(0) == static_cast<size_t>(self.count()), "the scene has another size");
    nb::gil_scoped_release release;
    self.opacity_logits(out.data());
}

}  // namespace

NB_MODULE(_gpu, m) {
    nb::class_<GpuScene>(m, "Scene")
        .def("set", &set_scene)
        .def("get", &get_scene, nb::arg("means").noconvert(), nb::arg("quats").noconvert(),
             nb::arg("log_scales").noconvert(), nb::arg("opacity_logits").noconvert(), nb::arg("colours").noconvert(),
             nb::arg("first").noconvert(), nb::arg("second").noconvert(), nb::arg("taken").noconvert())
        .def("select", &select_rows, nb::arg("rows"))
        .def("join", &join_splats)
        .def("opacity_logits", &opacity_logits, nb::arg("out").noconvert())
        .def_prop_ro("count", &GpuScene::count)
        .def_prop_ro("colours", &GpuScene::colours);
    nb::class_<GpuFrame>(m, "Frame");
    nb::class_<GpuSpikes>(m, "Spikes");
    nb::class_<GpuLight>(m, "Light");
    nb::class_<GpuRenderer> renderer(m, "Renderer");
    bind_passes<GpuRenderer>(renderer);
    renderer
        .def("forward", &forward_scene, nb::arg("scene"), nb::arg("rotations").noconvert(),
             nb::arg("centres").noconvert(), nb::arg("weights").none().noconvert(),
             nb::arg("windows").none().noconvert(), nb::arg("channels").none().noconvert(), nb::arg("background"),
             nb::arg("values").noconvert(), nb::arg("alpha").noconvert(), nb::arg("depth").noconvert())
        .def("descend", &descend, nb::arg("d_values").none(), nb::arg("scene"), nb::arg("rates"), nb::arg("blur"),
             nb::arg("own_axes"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("most_log_scale"),
             nb::arg("widest"), nb::arg("centre"))
        .def("scene", &GpuRenderer::scene)
        .def("frame", &frame, nb::arg("rates"), nb::arg("deviation"), nb::arg("windows").none(),
             nb::arg("channels").none())
        .def("compare", &compare, nb::arg("scene"), nb::arg("frame"), nb::arg("rotations"), nb::arg("centres"),
             nb::arg("background"), nb::arg("white"), nb::arg("floor"), nb::arg("share"), nb::arg("scale"),
             nb::arg("level").none(), nb::arg("model_error"), nb::arg("sigmas"))
        .def("slope", &slope, nb::arg("out").noconvert())
        .def("spikes", &spikes, nb::arg("bytes"), nb::kw_only(), nb::arg("width"), nb::arg("height"),
             nb::arg("row_stride"), nb::arg("flipped"), nb::arg("msb"), nb::arg("tile"))
        .def("light", &light, nb::arg("gain"), nb::arg("dark").none())
        .def("compare_charge", &compare_charge, nb::arg("scene"), nb::arg("spikes"), nb::arg("light"),
             nb::arg("rotations"), nb::arg("centres"), nb::arg("background"), nb::arg("turn"), nb::arg("shift"),
             nb::kw_only(), nb::arg("cell"), nb::arg("nearest"), nb::arg("pixel"), nb::arg("every"), nb::arg("phase"),
             nb::arg("level"), nb::arg("floor"), nb::arg("jitter"), nb::arg("white"), nb::arg("detail"),
             nb::arg("window"))
        .def("charge_slope", &charge_slope, nb::arg("out").noconvert())
        .def("set_gains", &set_gains, nb::arg("gain"))
        .def("add_evidence", &add_evidence, nb::arg("frame"), nb::arg("level"), nb::arg("model_error"))
        .def("set_evidence", &set_evidence, nb::arg("xx").noconvert(), nb::arg("xy").noconvert())
        .def("evidence", &evidence, nb::arg("xx").noconvert(), nb::arg("xy").noconvert());
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
