// The renderer on a GPU by CUDA. Its runtime is linked statically and finds the driver when it is used first, so that
// the module loads on machines without one.
#include <cuda_runtime.h>

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

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

namespace spiked {

namespace {

void check(cudaError_t status) {
    if (status == cudaSuccess) return;
    cudaGetLastError();  // the next call does not report it again
    throw std::runtime_error(std::string("the GPU failed: ") + cudaGetErrorString(status));
}

template <class Kernel>
__global__ void __launch_bounds__(Kernel::kThreads) run_kernel(const Kernel kernel) {
    kernel(Block<Kernel::kThreads>{blockIdx.x});
}

class Cuda {
  public:
    static constexpr const char* kName = "cuda";

    Cuda() { check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking)); }
    Cuda(const Cuda&) = delete;
    ~Cuda() {
        cudaStreamDestroy(stream_);
        cudaFreeHost(staging_);
        for (void* memory : outgrown_) cudaFreeHost(memory);
    }

    template <class T>
    class Buffer {
      public:
        Buffer() = default;
        Buffer(const Buffer&) = delete;
        ~Buffer() { cudaFree(data_); }

        T* grow(size_t count) {
            if (count <= room_) return data_;
            check(cudaFree(data_));  // waits for the kernels that use it
            data_ = nullptr, room_ = 0;
            const size_t room = count + count / 4;
            void* memory = nullptr;
            check(cudaMalloc(&memory, room * sizeof(T)));
            data_ = static_cast<T*>(memory), room_ = room;
            return data_;
        }
        T* data() { return data_; }
        void swap(Buffer& other) {
            std::swap(data_, other.data_);
            std::swap(room_, other.room_);
        }

      private:
        T* data_ = nullptr;
        size_t room_ = 0;
    };

    template <class T>
    const T* upload(Buffer<T>& buffer, const T* from, size_t count) {
        T* to = buffer.grow(count);
        put(to, from, count);
        return to;
    }

    template <class T>
    void put(T* to, const T* from, size_t count) {
        if (count == 0) return;
        void* through = stage(count * sizeof(T));
        std::memcpy(through, from, count * sizeof(T));
        check_call(cudaMemcpyAsync(to, through, count * sizeof(T), cudaMemcpyHostToDevice, stream_));
    }

    template <class T>
    void download(T* to, const T* from, size_t count) {
        if (count == 0) return;
        void* through = stage(count * sizeof(T));
        check_call(cudaMemcpyAsync(through, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream_));
        arriving_.push_back({to, through, count * sizeof(T)});
    }

    void finish() {
        const std::vector<Arriving> arrived = std::move(arriving_);
        arriving_.clear();
        check(cudaStreamSynchronize(stream_));
        for (const Arriving& one : arrived) std::memcpy(one.to, one.through, one.bytes);
        for (void* memory : outgrown_) cudaFreeHost(memory);
        outgrown_.clear();
        staged_ = 0;
    }

    template <class Kernel>
    void run(const Kernel& kernel, uint64_t blocks) {
        if (blocks == 0) return;
        run_kernel<<<static_cast<unsigned>(blocks), Kernel::kThreads, 0, stream_>>>(kernel);
        check(cudaGetLastError());
    }

    void sort(const uint32_t* keys, uint32_t* sorted_keys, const uint32_t* values, uint32_t* sorted_values,
              size_t count, int bits) {
        const auto sort_in = [&](void* scratch, size_t& bytes) {
            return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, values, sorted_values,
                                                   static_cast<int64_t>(count), 0, bits, stream_);
        };
        if (count > 0) with_scratch(sort_in);
    }

    void add_up(const uint64_t* counts, uint64_t* sums, size_t count) {
        with_scratch([&](void* scratch, size_t& bytes) {
            return cub::DeviceScan::ExclusiveSum(scratch, bytes, counts, sums, static_cast<int64_t>(count), stream_);
        });
    }

  private:
    struct Arriving {
        void* to;
        void* through;
        size_t bytes;
    };

    template <class Call>
    void with_scratch(Call call) {
        size_t bytes = 0;
        check(call(nullptr, bytes));
        check(call(scratch_.grow(bytes + 1), bytes));
    }

    // A call that fails gets nothing of what was on its way: its memory may be gone at the next finish().
    void check_call(cudaError_t status) {
        if (status != cudaSuccess) arriving_.clear();
        check(status);
    }

    // Page-locked memory, until finish().
    void* stage(size_t bytes) {
        bytes = (bytes + 255) / 256 * 256;
        if (staged_ + bytes > staging_room_) {
            // All that a call stages has to fit at last, or memory would be locked anew in every call.
            const size_t room = 2 * (staging_room_ + bytes) + (1 << 20);
            if (staging_) outgrown_.push_back(staging_);
            staging_ = nullptr, staging_room_ = 0, staged_ = 0;
            check_call(cudaMallocHost(&staging_, room));
            staging_room_ = room;
        }
        void* at = static_cast<char*>(staging_) + staged_;
        staged_ += bytes;
        return at;
    }

    cudaStream_t stream_ = nullptr;
    Buffer<char> scratch_;
    void* staging_ = nullptr;
    size_t staging_room_ = 0, staged_ = 0;
    std::vector<void*> outgrown_;
    std::vector<Arriving> arriving_;
};

}  // namespace

std::string why_no_cuda() {
    int devices = 0;
    const cudaError_t status = cudaGetDeviceCount(&devices);
    if (status != cudaSuccess) {
        cudaGetLastError();
        return std::string("CUDA finds no GPU: ") + cudaGetErrorString(status);
    }
    return devices == 0 ? "there is no GPU" : "";
}

std::unique_ptr<GpuRenderer> cuda_renderer(const PinholeF& camera) {
    const std::string reason = why_no_cuda();
    if (!reason.empty()) throw std::runtime_error(reason);
    return std::make_unique<Passes<Cuda>>(camera);
}

std::string cuda_device() {
    cudaDeviceProp properties;
    check(cudaGetDeviceProperties(&properties, 0));
    return properties.name;
}

}  // namespace spiked
