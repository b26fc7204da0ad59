// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>

namespace spiked {

void bind_normal_equations(nanobind::module_& m);
void bind_pose(nanobind::module_& m);
void bind_triangulate(nanobind::module_& m);

}  // namespace spiked
