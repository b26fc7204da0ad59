// Functions by which each file adds its bindings to the module.
#pragma once
#include <nanobind/nanobind.h>

namespace spiked {

void bind_landmarks(nanobind::module_& m);
void bind_nuisances(nanobind::module_& m);
void bind_photometric(nanobind::module_& m);
void bind_plane_sweep(nanobind::module_& m);
void bind_signed_distance(nanobind::module_& m);

}  // namespace spiked
