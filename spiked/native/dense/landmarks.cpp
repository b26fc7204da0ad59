// Marginalises the landmarks of many views: what is left are normal equations of the poses alone.
#include "landmarks.hpp"

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "../common/arrays.hpp"
#include "../common/clones.hpp"
#include "bindings.hpp"

namespace spiked {
namespace {

struct Sighting {
    int64_t key;
    int32_t view;
    const float* block;  // [kLandmark, kRow]
};

// A landmark's own normal equations.
struct Own {
    double hessian[kLandmark][kLandmark], gradient[kLandmark];

    double trace() const { return (hessian[0][0] + hessian[1][1] + hessian[2][2]) / kLandmark; }
};

Own sum_of(const Sighting* sightings, size_t count) {
    Own sum{};
    for (size_t n = 0; n < count; ++n) {
        for (int i = 0; i < kLandmark; ++i) {
            const float* row = sightings[n].block + i * kRow;
            for (int j = 0; j < kLandmark; ++j) sum.hessian[i][j] += row[j];
            sum.gradient[i] += row[kRow - 1];
        }
    }
    return sum;
}

// The inverse of the Cholesky factor of hessian + damping: root * (hessian + damping) * root^T = 1. Lower triangular.
void inverse_root(const Own& own, double damping, double (&root)[kLandmark][kLandmark]) {
    double lower[kLandmark][kLandmark] = {};
    for (int i = 0; i < kLandmark; ++i) {
        for (int j = 0; j <= i; ++j) {
            double left = own.hessian[i][j] + (i == j ? damping : 0.0);
            for (int k = 0; k < j; ++k) left -= lower[i][k] * lower[j][k];
            lower[i][j] = i == j ? std::sqrt(left) : left / lower[j][j];
        }
    }
    for (int j = 0; j < kLandmark; ++j) {
        for (int i = 0; i < kLandmark; ++i) {
            double left = i == j ? 1.0 : 0.0;
            for (int k = j; k < i; ++k) left -= lower[i][k] * root[k][j];
            root[i][j] = i < j ? 0.0 : left / lower[i][i];
        }
    }
}

// The part of a sighting that couples landmark and pose, by the root: [kLandmark, kPose].
void whiten(const double (&root)[kLandmark][kLandmark], const float* block, double* out) {
    for (int i = 0; i < kLandmark; ++i) {
        for (int j = 0; j < kPose; ++j) {
            double sum = 0;
            for (int k = 0; k <= i; ++k) sum += root[i][k] * block[k * kRow + kLandmark + j];
            out[i * kPose + j] = sum;
        }
    }
}

// square -= first^T second, a block [kPose, kPose] of a matrix with rows `stride` long.
SPIKED_INLINE void subtract_product(const double* first, const double* second, double* square, size_t stride) {
    for (int i = 0; i < kPose; ++i) {
        for (int j = 0; j < kPose; ++j) {
            double sum = 0;
            for (int k = 0; k < kLandmark; ++k) sum += first[k * kPose + i] * second[k * kPose + j];
            square[i * stride + j] -= sum;
        }
    }
}

// Subtracts what all pairs of `count` sightings of a landmark say, in the upper triangle of blocks.
SPIKED_CLONES void subtract_pairs(const double* whitened, const Sighting* sightings, size_t count, double* square,
                                  size_t stride) {
    for (size_t a = 0; a < count; ++a) {
        double* rows = square + kPose * sightings[a].view * stride;
        for (size_t b = a; b < count; ++b) {
            subtract_product(whitened + a * kLandmark * kPose, whitened + b * kLandmark * kPose,
                             rows + kPose * sightings[b].view, stride);
        }
    }
}

std::vector<Sighting> sightings_of(const std::vector<Array<const int64_t, 1>>& keys,
                                   const std::vector<Array<const float, 3>>& blocks) {
    expect(keys.size() == blocks.size(), "expected keys and blocks of the same views");
    std::vector<Sighting> sightings;
    for (size_t view = 0; view < keys.size(); ++view) {
        expect(keys[view].shape(0) == blocks[view].shape(0) && blocks[view].shape(1) == kLandmark &&
                   blocks[view].shape(2) == kRow,
               "expected blocks [N, 3, 10] of N keys in each view");
        for (size_t n = 0; n < keys[view].shape(0); ++n) {
            sightings.push_back(
                {keys[view].data()[n], static_cast<int32_t>(view), blocks[view].data() + n * kLandmark * kRow});
        }
    }
    return sightings;
}

void marginalise(const std::vector<Array<const int64_t, 1>>& keys, const std::vector<Array<const float, 3>>& blocks,
                 double damping, double damping_floor, const Array<double, 2>& square,
                 const Array<double, 1>& gradient) {
    const size_t side = kPose * keys.size();
    expect(square.shape(0) == side && square.shape(1) == side && gradient.shape(0) == side,
           "expected square [6 V, 6 V] and gradient [6 V] of V views");
    std::vector<Sighting> sightings = sightings_of(keys, blocks);
    std::sort(sightings.begin(), sightings.end(), [](const Sighting& one, const Sighting& other) {
        return one.key != other.key ? one.key < other.key : one.view < other.view;
    });
    std::vector<size_t> begins;
    for (size_t n = 0; n < sightings.size(); ++n) {
        if (n == 0 || sightings[n].key != sightings[n - 1].key) begins.push_back(n);
    }
    if (begins.empty()) return;
    const auto count_of = [&](size_t landmark) {
        return (landmark + 1 < begins.size() ? begins[landmark + 1] : sightings.size()) - begins[landmark];
    };
    std::vector<double> traces(begins.size());
    std::vector<size_t> order(begins.size());  // by the first view, so that neighbours change the same blocks
    for (size_t landmark = 0; landmark < begins.size(); ++landmark) {
        traces[landmark] = sum_of(&sightings[begins[landmark]], count_of(landmark)).trace();
        order[landmark] = landmark;
    }
    std::stable_sort(order.begin(), order.end(), [&](size_t one, size_t other) {
        return sightings[begins[one]].view < sightings[begins[other]].view;
    });
    std::nth_element(traces.begin(), traces.begin() + traces.size() / 2, traces.end());
    const double floor = damping_floor * traces[traces.size() / 2];
    std::vector<double> whitened;
    for (const size_t landmark : order) {
        const Sighting* seen = &sightings[begins[landmark]];
        const size_t count = count_of(landmark);
        const Own own = sum_of(seen, count);
        const double held = damping * own.trace() + floor;
        if (!(held > 0)) continue;  // nothing was seen of it
        double root[kLandmark][kLandmark], pull[kLandmark] = {};
        inverse_root(own, held, root);
        for (int i = 0; i < kLandmark; ++i) {
            for (int k = 0; k <= i; ++k) pull[i] += root[i][k] * own.gradient[k];
        }
        whitened.resize(count * kLandmark * kPose);
        for (size_t n = 0; n < count; ++n) {
            double* one = whitened.data() + n * kLandmark * kPose;
            whiten(root, seen[n].block, one);
            for (int j = 0; j < kPose; ++j) {
                for (int i = 0; i < kLandmark; ++i) {
                    gradient.data()[kPose * seen[n].view + j] -= pull[i] * one[i * kPose + j];
                }
            }
        }
        subtract_pairs(whitened.data(), seen, count, square.data(), side);
    }
    for (size_t row = 0; row < side; ++row) {
        for (size_t column = 0; column < row; ++column)
            square.data()[row * side + column] = square.data()[column * side + row];
    }
}

}  // namespace

void bind_landmarks(nb::module_& m) {
    m.def(
        "marginalise", &marginalise, nb::arg("keys"), nb::arg("blocks"), nb::arg("damping"), nb::arg("damping_floor"),
        nb::arg("square").noconvert(), nb::arg("gradient").noconvert(),
        "Subtracts what V views, each with `keys` [N] and `blocks` [N, 3, 10] of `photometric_normals`, say of their "
        "poses\n"
        "only through landmarks (Schur complement), from the Hessian `square` [6 V, 6 V], of which the lower triangle "
        "is\n"
        "taken from the upper one, and from the `gradient` [6 V] of the poses. Each landmark is held by `damping` "
        "times its own\n"
        "information and `damping_floor` times the median landmark's.");
}

}  // namespace spiked
