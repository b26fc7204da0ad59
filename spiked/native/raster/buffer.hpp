// Memory that is kept between frames: it grows and never shrinks, its contents are undefined after growing.
#pragma once
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>

namespace spiked {

constexpr size_t kHugePage = size_t{2} << 20;  // bytes

template <class T>
class Buffer {
    static_assert(std::is_trivially_copyable_v<T>);

  public:
    T* grow(size_t count) {
        if (count > capacity_) {
            size_t bytes = (count + count / 4) * sizeof(T);
            const size_t alignment = bytes < kHugePage ? 64 : kHugePage;
            bytes = (bytes + alignment - 1) / alignment * alignment;
            data_.reset();
            capacity_ = 0;
            data_.reset(static_cast<T*>(std::aligned_alloc(alignment, bytes)));
            if (!data_) throw std::bad_alloc();
#if defined(__linux__)
            // Splats lie scattered over these arrays: a page each would not fit the address caches. Only a wish.
            if (alignment == kHugePage) madvise(data_.get(), bytes, MADV_HUGEPAGE);
#endif
            capacity_ = bytes / sizeof(T);
        }
        return data_.get();
    }
    T* data() const { return data_.get(); }
    T& operator[](size_t i) const { return data_.get()[i]; }

  private:
    struct Free {
        void operator()(T* p) const { std::free(p); }
    };
    std::unique_ptr<T, Free> data_;
    size_t capacity_ = 0;
};

}  // namespace spiked
