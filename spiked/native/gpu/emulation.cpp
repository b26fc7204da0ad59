// The emulation: memory is the host's, and the blocks of a grid run one after the other.
#include "renderer.hpp"

// Each part uses the ones before it.
// clang-format off
#include "block.hpp"
#include "../raster/project.inl"
#include "../raster/moving_camera.inl"
#include "../raster/similarity.inl"
#include "../dense/nuisances.hpp"
#include "../charge/pixel.hpp"
#include "../charge/warp_node.hpp"
#include "kernels.inl"
#include "compare.inl"
#include "charge.inl"
#include "compare_passes.inl"
#include "charge_passes.inl"
#include "passes.inl"
// clang-format on

#include <numeric>

namespace spiked {

namespace {

class Emulation {
  public:
    static constexpr const char* kName = "emulated GPU";

    template <class T>
    class Buffer {
      public:
        T* grow(size_t count) {
            values_.assign(count, T{});
            return values_.data();
        }
        T* data() { return values_.data(); }
        void swap(Buffer& other) { values_.swap(other.values_); }

      private:
        std::vector<T> values_;
    };

    template <class T>
    const T* upload(Buffer<T>& buffer, const T* from, size_t count) {
        T* to = buffer.grow(count);
        std::copy_n(from, count, to);
        return to;
    }

    template <class T>
    void put(T* to, const T* from, size_t count) {
        std::copy_n(from, count, to);
    }

    template <class T>
    void download(T* to, const T* from, size_t count) {
        std::copy_n(from, count, to);
    }

    void finish() {}

    template <class Kernel>
    void run(const Kernel& kernel, uint64_t blocks) {
        for (uint64_t i = 0; i < blocks; ++i) kernel(Block<Kernel::kThreads>{static_cast<uint32_t>(i)});
    }

    void sort(const uint32_t* keys, uint32_t* sorted_keys, const uint32_t* values, uint32_t* sorted_values,
              size_t count, int) {
        std::vector<uint32_t> order(count);
        std::iota(order.begin(), order.end(), 0u);
        std::stable_sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) { return keys[a] < keys[b]; });
        for (size_t i = 0; i < count; ++i) {
            sorted_keys[i] = keys[order[i]];
            sorted_values[i] = values[order[i]];
        }
    }

    void add_up(const uint64_t* counts, uint64_t* sums, size_t count) {
        uint64_t sum = 0;
        for (size_t i = 0; i < count; ++i) {
            sums[i] = sum;
            sum += counts[i];
        }
    }
};

}  // namespace

std::unique_ptr<GpuRenderer> emulated_renderer(const PinholeF& camera) {
    return std::make_unique<Passes<Emulation>>(camera);
}

}  // namespace spiked
