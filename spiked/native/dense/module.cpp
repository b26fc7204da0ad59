// Comparison of whole images: dense alignment of a view with the map, the plane sweep, and signed distances.
#include "bindings.hpp"

NB_MODULE(_dense, m) {
    spiked::bind_landmarks(m);
    spiked::bind_nuisances(m);
    spiked::bind_photometric(m);
    spiked::bind_plane_sweep(m);
    spiked::bind_signed_distance(m);
}
