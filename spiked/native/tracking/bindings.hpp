// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>

namespace spiked {

void bind_lucas_kanade(nanobind::module_& m);
void bind_warp(nanobind::module_& m);

}  // namespace spiked
