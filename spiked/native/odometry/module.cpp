// What the odometry does for every view, compiled: tracks, poses, adjustment.
#include "arrays.hpp"

NB_MODULE(_odometry, m) {
    spiked::bind_dense(m);
    spiked::bind_depth(m);
    spiked::bind_normal(m);
    spiked::bind_pose(m);
    spiked::bind_flow(m);
    spiked::bind_light(m);
    spiked::bind_place(m);
    spiked::bind_rotation(m);
}
