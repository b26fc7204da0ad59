// Comparison of whole images: dense alignment of a view with the map, and the plane sweep.
#include "bindings.hpp"

NB_MODULE(_dense, m) {
    spiked::bind_photometric(m);
    spiked::bind_plane_sweep(m);
}
