#include "kernels.hpp"

#if defined(__AVX512BITALG__) && defined(__GFNI__)
#include "kernels.inl"

namespace spiked {

const Kernels* avx512_kernels() {
    static const Kernels kernels = {"avx512", reduce, window, unpack};
    return &kernels;
}

}  // namespace spiked

#else

namespace spiked {

const Kernels* avx512_kernels() { return nullptr; }

}  // namespace spiked

#endif
