// Python bindings of the simulator: check shapes, then work without the interpreter's lock.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <stdexcept>

#include "../common/pool.hpp"
#include "room.hpp"
#include "sensor.hpp"

namespace nb = nanobind;
using namespace spiked;

namespace {

template <class T, int N>
using Array = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
using Map = Array<const float, 2>;

void require(bool condition, const char* message) {
    if (!condition) throw std::invalid_argument(message);
}

void expose(Map first, Map last, Array<const float, 1> weights, Array<const float, 1> gains, int64_t first_frame,
            Map gain, Map dark, Map threshold, Map noise_factor, float jitter, uint64_t seed, Array<float, 2> missing,
            Array<uint8_t, 2> out, int stride, bool flipped, bool msb_first, bool row_tagged, int threads) {
    const size_t height = missing.shape(0), width = missing.shape(1);
    for (const Map* map : {&first, &last, &gain, &dark, &threshold, &noise_factor}) {
        require(map->shape(0) == height && map->shape(1) == width, "every map must be [height, width]");
    }
    require(width % 8 == 0, "the width must be a multiple of 8");
    require(static_cast<size_t>(stride) >= width / 8 + (row_tagged ? 2 : 0), "a row does not fit its stride");
    require(weights.shape(0) == out.shape(0) && gains.shape(0) == out.shape(0), "one weight and gain a frame");
    require(out.shape(1) == static_cast<size_t>(stride) * height, "out must be [count, stride * height]");
    require(threads >= 1, "at least one thread");

    const Exposure exposure{first.data(), last.data(), weights.data(),
                            gains.data(), first_frame, static_cast<int64_t>(out.shape(0))};
    const PixelMaps maps{gain.data(), dark.data(), threshold.data(), noise_factor.data()};
    const FrameFormat format{static_cast<int>(width), static_cast<int>(height), stride, flipped, msb_first, row_tagged};
    float* charge = missing.data();
    uint8_t* bytes = out.data();
    nb::gil_scoped_release release;
    const auto part = [&](int i) { return static_cast<int>(static_cast<int64_t>(format.height) * i / threads); };
    Pool(threads).run(threads, [&](int i, int) {
        expose_rows(exposure, maps, format, jitter, seed, charge, bytes, part(i), part(i + 1));
    });
}

Room make_room(int channels, Array<const float, 2> boxes, Array<const int32_t, 2> faces,
               Array<const int64_t, 2> textures, Array<const float, 1> texels_per_unit,
               Array<const uint16_t, 1> texels) {
    require(channels == 1 || channels == 3, "a room is grey (1) or colour (3)");
    require(boxes.shape(0) >= 1 && boxes.shape(1) == 15, "boxes must be [n, 15]: centre, axes, half size");
    require(faces.shape(0) == boxes.shape(0) && faces.shape(1) == 6, "faces must be [n, 6]");
    require(textures.shape(1) == 4 && texels_per_unit.shape(0) == textures.shape(0),
            "textures must be [m, 4]: offset, width, height, levels");
    Room room{channels, {}, {}, {}};
    for (size_t i = 0; i < textures.shape(0); ++i) {
        const int64_t* t = textures.data() + 4 * i;
        int64_t end = t[0], width = t[1], height = t[2];
        require(width >= 1 && height >= 1 && t[3] >= 1, "a texture has a size and a level");
        for (int64_t level = 0; level < t[3]; ++level) {
            end += width * height;
            width = std::max<int64_t>(width / 2, 1), height = std::max<int64_t>(height / 2, 1);
        }
        require(t[0] >= 0 && static_cast<size_t>(end * channels) <= texels.shape(0),
                "a texture lies outside its texels");
        room.textures.push_back(
            {t[0], static_cast<int>(t[1]), static_cast<int>(t[2]), static_cast<int>(t[3]), texels_per_unit.data()[i]});
    }
    for (size_t i = 0; i < boxes.shape(0); ++i) {
        Box box;
        const float* b = boxes.data() + 15 * i;
        std::copy_n(b, 3, box.centre);
        std::copy_n(b + 3, 9, box.axes);
        std::copy_n(b + 12, 3, box.half);
        std::copy_n(faces.data() + 6 * i, 6, box.textures);
        for (const int t : box.textures)
            require(t >= 0 && static_cast<size_t>(t) < room.textures.size(), "no such texture");
        room.boxes.push_back(box);
    }
    room.texels.assign(texels.data(), texels.data() + texels.shape(0));
    return room;
}

void render(const Room& room, Array<const double, 2> rotation, Array<const double, 1> centre, float fx, float fy,
            float cx, float cy, Array<float, 3> image, Array<float, 2> depth, int threads) {
    require(rotation.shape(0) == 3 && rotation.shape(1) == 3 && centre.shape(0) == 3, "a pose is [3, 3] and [3]");
    require(image.shape(0) == depth.shape(0) && image.shape(1) == depth.shape(1) &&
                image.shape(2) == static_cast<size_t>(room.channels),
            "image must be [height, width, channels] and depth [height, width]");
    require(threads >= 1, "at least one thread");
    Pinhole camera{static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0)), fx, fy, cx, cy, {}, {}};
    std::copy_n(rotation.data(), 9, camera.rotation);
    std::copy_n(centre.data(), 3, camera.centre);
    float *pixels = image.data(), *z = depth.data();
    nb::gil_scoped_release release;
    room.render(camera, pixels, z, threads);
}

}  // namespace

NB_MODULE(_simulate, m) {
    m.def("expose", &expose, nb::arg("first"), nb::arg("last"), nb::arg("weights"), nb::arg("gains"),
          nb::arg("first_frame"), nb::arg("gain"), nb::arg("dark"), nb::arg("threshold"), nb::arg("noise_factor"),
          nb::arg("jitter"), nb::arg("seed"), nb::arg("missing").noconvert(), nb::arg("out").noconvert(),
          nb::arg("stride"), nb::arg("flipped"), nb::arg("msb_first"), nb::arg("row_tagged"), nb::arg("threads"));
    nb::class_<Room>(m, "Room")
        .def_ro("channels", &Room::channels)
        .def("render", &render, nb::arg("rotation"), nb::arg("centre"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"),
             nb::arg("cy"), nb::arg("image").noconvert(), nb::arg("depth").noconvert(), nb::arg("threads"));
    m.def("make_room", &make_room, nb::arg("channels"), nb::arg("boxes"), nb::arg("faces"), nb::arg("textures"),
          nb::arg("texels_per_unit"), nb::arg("texels"));
}
