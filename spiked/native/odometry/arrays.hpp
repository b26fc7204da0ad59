// The arrays that Python hands over.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

namespace nb = nanobind;

namespace spiked {

template <class T, int N>
using Array = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

void bind_dense(nb::module_& m);
void bind_depth(nb::module_& m);
void bind_normal(nb::module_& m);
void bind_pose(nb::module_& m);
void bind_flow(nb::module_& m);
void bind_light(nb::module_& m);
void bind_place(nb::module_& m);
void bind_rotation(nb::module_& m);

}  // namespace spiked
