#include "kernels.inl"

namespace spiked {

const Kernels* baseline_kernels() {
    static const Kernels kernels = {"baseline", reduce, window, unpack};
    return &kernels;
}

}  // namespace spiked
