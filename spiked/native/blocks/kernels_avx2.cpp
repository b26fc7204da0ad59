#include "kernels.hpp"

#if defined(__AVX2__)
#include "kernels.inl"

namespace spiked {

const Kernels* avx2_kernels() {
    static const Kernels kernels = {"avx2", reduce, window, unpack};
    return &kernels;
}

}  // namespace spiked

#else

namespace spiked {

const Kernels* avx2_kernels() { return nullptr; }

}  // namespace spiked

#endif
