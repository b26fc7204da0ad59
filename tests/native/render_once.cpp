// Renders once without Python, so that the kernels of a processor that is only emulated can be checked.
// in: int32 splats, colours, width, height, poses; float32 fx, fy, cx, cy, near; the splats' arrays, windows [2][H][W],
// d_values [H][W] or [H][W][3]; float64 rotations and centres. out: float32 values and gradients, float64 poses'.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "../../spiked/native/raster/renderer.hpp"

namespace {

template <class T>
std::vector<T> read(std::FILE* file, size_t count) {
    std::vector<T> data(count);
    if (std::fread(data.data(), sizeof(T), count, file) != count) {
        std::fputs("the input ends early\n", stderr);
        std::exit(2);
    }
    return data;
}

template <class T>
void write(std::FILE* file, const std::vector<T>& data) {
    std::fwrite(data.data(), sizeof(T), data.size(), file);
}

}  // namespace

int main(int, char** paths) {
    std::FILE* in = std::fopen(paths[1], "rb");
    const auto sizes = read<int32_t>(in, 5);
    const size_t n = sizes[0], colours = sizes[1], width = sizes[2], height = sizes[3], poses = sizes[4];
    const auto optics = read<float>(in, 5);
    const auto means = read<float>(in, 3 * n), quats = read<float>(in, 4 * n), scales = read<float>(in, 3 * n);
    const auto logits = read<float>(in, n), colour = read<float>(in, colours * n);
    const auto windows = read<float>(in, 2 * width * height), d_values = read<float>(in, colours * width * height);
    const auto rotations = read<double>(in, 9 * poses), centres = read<double>(in, 3 * poses);
    std::fclose(in);

    spiked::PinholeF camera{};
    camera.fx = optics[0], camera.fy = optics[1], camera.cx = optics[2], camera.cy = optics[3], camera.near = optics[4];
    camera.limit_x = static_cast<float>(1.3 * 0.5 * width / camera.fx);
    camera.limit_y = static_cast<float>(1.3 * 0.5 * height / camera.fy);
    camera.width = sizes[2], camera.height = sizes[3];
    camera.tiles_x = (camera.width + spiked::kTile - 1) / spiked::kTile;
    camera.tiles_y = (camera.height + spiked::kTile - 1) / spiked::kTile;
    spiked::Renderer renderer(camera, 2);

    const spiked::SplatArrays splats{sizes[0],      sizes[1],      means.data(), quats.data(),
                                     scales.data(), logits.data(), colour.data()};
    const spiked::Views views{
        rotations.data(), centres.data(), sizes[4], nullptr, windows.data(), windows.data() + width * height, nullptr};
    const float background[3] = {0.1f, 0.1f, 0.1f};
    std::vector<float> values(colours * width * height), alpha(width * height), depth(width * height);
    renderer.forward(splats, views, background, values.data(), alpha.data(), depth.data());
    std::vector<float> d_means(3 * n), d_quats(4 * n), d_scales(3 * n), d_logits(n), d_colour(colours * n), rest(2 * n);
    std::vector<double> d_rotation(3 * poses), d_centre(3 * poses);
    renderer.backward(d_values.data(),
                      {d_means.data(), d_quats.data(), d_scales.data(), d_logits.data(), d_colour.data(),
                       d_rotation.data(), d_centre.data(), rest.data(), rest.data() + n});

    std::FILE* out = std::fopen(paths[2], "wb");
    for (const auto* array : {&values, &d_means, &d_quats, &d_scales, &d_logits, &d_colour}) write(out, *array);
    write(out, d_rotation);
    write(out, d_centre);
    std::fclose(out);
    std::puts(renderer.instructions());
}
