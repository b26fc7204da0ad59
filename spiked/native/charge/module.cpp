// The charge loss, and the displacements that it needs.
#include "bindings.hpp"

NB_MODULE(_charge, m) {
    spiked::bind_charge(m);
    spiked::bind_warp_nodes(m);
}
