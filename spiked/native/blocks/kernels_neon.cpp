#include "kernels.hpp"

#if defined(__aarch64__)
#define SPIKED_NEON 1
#include "kernels.inl"

namespace spiked {

const Kernels* neon_kernels() {
    static const Kernels kernels = {"neon", reduce, window, unpack};
    return &kernels;
}

}  // namespace spiked

#else

namespace spiked {

const Kernels* neon_kernels() { return nullptr; }

}  // namespace spiked

#endif
