// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>

#include "../common/arrays.hpp"

namespace spiked {

void bind_adam(nb::module_& m);
void bind_ssim(nb::module_& m);

}  // namespace spiked
