// Bundle adjustment, the pose of one view, triangulation.
#include "bindings.hpp"

NB_MODULE(_bundle, m) {
    spiked::bind_normal_equations(m);
    spiked::bind_pose(m);
    spiked::bind_triangulate(m);
}
