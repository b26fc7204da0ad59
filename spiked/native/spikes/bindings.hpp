// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>

namespace spiked {

void bind_blocks(nanobind::module_& m);
void bind_rates(nanobind::module_& m);

}  // namespace spiked
