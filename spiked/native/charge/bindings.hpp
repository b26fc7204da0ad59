// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>

namespace spiked {

void bind_charge(nanobind::module_& m);
void bind_warp_nodes(nanobind::module_& m);

}  // namespace spiked
