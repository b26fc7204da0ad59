// The arrays that Python passes: C-contiguous, in main memory. `const T` is read only.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <stdexcept>

namespace nb = nanobind;

namespace spiked {

template <class T, int N>
using Array = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

// Of any number of dimensions.
template <class T>
using AnyArray = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

// Stored frames [n, frame_bytes]; the frames may lie any distance apart.
using Frames = nb::ndarray<const uint8_t, nb::ndim<2>, nb::device::cpu>;

inline void expect(bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(what);
}

}  // namespace spiked
