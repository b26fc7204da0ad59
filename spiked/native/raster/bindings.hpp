// Array types of the bindings: C-contiguous, in main memory.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <stdexcept>

namespace raster {

template <class T, int N>
using Read = nanobind::ndarray<const T, nanobind::ndim<N>, nanobind::c_contig, nanobind::device::cpu>;
template <class T, int N>
using Write = nanobind::ndarray<T, nanobind::ndim<N>, nanobind::c_contig, nanobind::device::cpu>;
template <class T>
using ReadAny = nanobind::ndarray<const T, nanobind::c_contig, nanobind::device::cpu>;
template <class T>
using WriteAny = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu>;

inline void expect(bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(what);
}

void bind_losses(nanobind::module_&);
void bind_charge(nanobind::module_&);

}  // namespace raster
