// Spike-aligned windows of frames: checks shapes, collects frame pointers and selects the instruction set.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/dispatch.hpp"
#include "bindings.hpp"
#include "kernels.hpp"

namespace spiked {
namespace {

std::vector<const SpikeKernels*> supported_kernels() {
#if defined(__x86_64__)
    const CpuFeatures cpu = cpu_features();
    const bool avx2 = cpu.avx2 && cpu.bmi2;
    const bool avx512 = cpu.avx512bw && cpu.avx512vl && cpu.avx512bitalg && cpu.gfni;
    return runnable_kernels<SpikeKernels>(
        {{spike_kernels_avx512, avx512}, {spike_kernels_avx2, avx2}, {spike_kernels_baseline, true}});
#elif defined(__aarch64__)
    return runnable_kernels<SpikeKernels>({{spike_kernels_neon, true}, {spike_kernels_baseline, true}});
#else
    return runnable_kernels<SpikeKernels>({{spike_kernels_baseline, true}});
#endif
}

const SpikeKernels& kernels_named(const std::string& name) {
    static const std::vector<const SpikeKernels*> supported = supported_kernels();
    if (name.empty()) return *supported.front();
    for (const SpikeKernels* kernels : supported) {
        if (name == kernels->name) return *kernels;
    }
    throw std::invalid_argument("this machine has no kernels for the instruction set " + name);
}

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names;
    for (const SpikeKernels* kernels : supported_kernels()) names.emplace_back(kernels->name);
    return names;
}

struct Layout {
    size_t width, height, row_stride;
    bool flipped, msb;
};

FrameLayout layout_of(const Layout& layout, const Frames& frames) {
    if (layout.width == 0 || layout.width % 8 || layout.row_stride < layout.width / 8) {
        throw std::invalid_argument("a row is whole bytes and fits its stride");
    }
    if (frames.shape(1) != layout.row_stride * layout.height || frames.stride(1) != 1) {
        throw std::invalid_argument("frames must be uint8 [n, " + std::to_string(layout.row_stride * layout.height) +
                                    "] with contiguous bytes for this sensor, not [" + std::to_string(frames.shape(0)) +
                                    ", " + std::to_string(frames.shape(1)) + "]");
    }
    const size_t padded = (layout.width / 8 + kMaxLoad - 1) / kMaxLoad * kMaxLoad;
    const size_t bytes = layout.row_stride * layout.height;
    const size_t tail = bytes < padded ? 0 : std::min((bytes - padded) / layout.row_stride + 1, layout.height);
    return {layout.width, layout.height, layout.row_stride, padded, tail, layout.flipped, layout.msb};
}

// Pointers to frames in any order, padded with empty frames, and padded copies of each frame's last rows.
class FrameList {
  public:
    FrameList(const FrameLayout& layout, const Frames& frames) : layout_(layout), frames_(frames) {
        tail_bytes_ = (layout.height - layout.tail_row) * layout.row_stride;
        empty_.resize(layout.row_stride * layout.height + layout.padded_row);
    }

    // `count` frames from `first` on in steps of +1 or -1. The run is valid until the list dies.
    Run run(int64_t first, int64_t step, int64_t count) {
        const int64_t blocks = (count + 7) / 8;
        pointers_.emplace_back(blocks * 16, empty_.data());
        std::vector<const uint8_t*>& pointers = pointers_.back();
        tails_.emplace_back(count * (tail_bytes_ + layout_.padded_row));
        uint8_t* tail = tails_.back().data();
        for (int64_t i = 0; i < count; ++i) {
            const uint8_t* frame = frames_.data() + (first + step * i) * frames_.stride(0);
            std::memcpy(tail, frame + layout_.tail_row * layout_.row_stride, tail_bytes_);
            pointers[i] = frame;
            pointers[blocks * 8 + i] = tail;
            tail += tail_bytes_ + layout_.padded_row;
        }
        return {pointers.data(), pointers.data() + blocks * 8, static_cast<int>(blocks)};
    }

  private:
    const FrameLayout& layout_;
    const Frames& frames_;
    size_t tail_bytes_;
    std::vector<uint8_t> empty_;
    std::vector<std::vector<const uint8_t*>> pointers_;
    std::vector<std::vector<uint8_t>> tails_;
};

template <class Array>
void check_image(const Array& array, const FrameLayout& g, size_t axis) {
    if (array.shape(axis) != g.height || array.shape(axis + 1) != g.width) {
        throw std::invalid_argument("an output array does not have the sensor's height and width");
    }
}

void aligned_window(const Frames& frames, const Layout& layout, int64_t begin, int64_t end,
                    const Array<uint16_t, 2>& spikes, const Array<uint16_t, 2>& start, const Array<uint16_t, 2>& stop,
                    const Array<uint16_t, 2>& count, const std::string& instruction_set) {
    const FrameLayout g = layout_of(layout, frames);
    const SpikeKernels& kernels = kernels_named(instruction_set);
    const int64_t n = frames.shape(0);
    if (begin < 0 || begin >= end || end > n) {
        throw std::invalid_argument("the window [begin, end) must be non-empty and inside the frames given");
    }
    if (n >= kNever16) throw std::invalid_argument("at most 65534 frames at a time");
    for (const auto* out : {&spikes, &start, &stop, &count}) check_image(*out, g, 0);
    nb::gil_scoped_release release;
    FrameList list(g, frames);
    std::vector<uint16_t> scratch(kWindowRows * g.padded_row * 8);
    WindowJob job = {g,
                     list.run(begin - 1, -1, begin),
                     list.run(begin, 1, end - begin),
                     list.run(end, 1, n - end),
                     static_cast<uint16_t>(begin),
                     static_cast<uint16_t>(end),
                     scratch.data(),
                     spikes.data(),
                     start.data(),
                     stop.data(),
                     count.data()};
    kernels.window(job);
}

// Bits of frames to upright images of bytes, 0 or 1.
void unpack_frames(const Frames& frames, const Layout& layout, const Array<uint8_t, 3>& images) {
    const FrameLayout g = layout_of(layout, frames);
    const SpikeKernels& kernels = kernels_named("");
    check_image(images, g, 1);
    if (images.shape(0) < frames.shape(0)) throw std::invalid_argument("the output holds fewer images than frames");
    nb::gil_scoped_release release;
    uint8_t* out = images.data();
    for (size_t n = 0; n < frames.shape(0); ++n) {
        const uint8_t* frame = frames.data() + static_cast<int64_t>(n) * frames.stride(0);
        for (size_t y = 0; y < g.height; ++y, out += g.width)
            kernels.unpack(frame + (g.flipped ? g.height - 1 - y : y) * g.row_stride, g.width / 8, g.msb, out);
    }
}

}  // namespace

void bind_blocks(nb::module_& m) {
    nb::class_<Layout>(m, "Layout")
        .def(nb::init<size_t, size_t, size_t, bool, bool>(), nb::arg("width"), nb::arg("height"), nb::arg("row_stride"),
             nb::arg("flipped"), nb::arg("msb"));
    m.def("instruction_sets", &instruction_sets, "Instruction sets this machine can run, best first.");
    m.def("unpack_frames", &unpack_frames, nb::arg("frames").noconvert(), nb::arg("layout"),
          nb::arg("images").noconvert());
    m.def("aligned_window", &aligned_window, nb::arg("frames").noconvert(), nb::arg("layout"), nb::arg("begin"),
          nb::arg("end"), nb::arg("spikes").noconvert(), nb::arg("start").noconvert(), nb::arg("stop").noconvert(),
          nb::arg("count").noconvert(), nb::arg("instruction_set") = "");
}

}  // namespace spiked
