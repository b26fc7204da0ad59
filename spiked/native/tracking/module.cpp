// Feature tracks and motion compensation.
#include "bindings.hpp"

NB_MODULE(_tracking, m) {
    spiked::bind_lucas_kanade(m);
    spiked::bind_warp(m);
}
