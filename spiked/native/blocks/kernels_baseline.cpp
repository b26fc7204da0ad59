#include "kernels.inl"

namespace spiked {

const Kernels* baseline_kernels() {
    static const Kernels kernels = {"baseline", reduce, window};
    return &kernels;
}

}  // namespace spiked
