// Memory that is kept between frames: it grows and never shrinks, its contents are undefined after growing.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>

namespace raster {

template <class T>
class Buffer {
    static_assert(std::is_trivially_copyable_v<T>);

  public:
    T* grow(size_t count) {
        if (count > capacity_) {
            size_t bytes = (count + count / 4) * sizeof(T);
            bytes = (bytes + 63) / 64 * 64;
            data_.reset();
            capacity_ = 0;
            data_.reset(static_cast<T*>(std::aligned_alloc(64, bytes)));
            if (!data_) throw std::bad_alloc();
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

}  // namespace raster
