// From frames of spikes to spike-aligned windows, and from these to rates.
#include "bindings.hpp"

NB_MODULE(_spikes, m) {
    spiked::bind_blocks(m);
    spiked::bind_rates(m);
}
