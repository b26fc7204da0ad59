// The vector operations of common/simd.hpp with a single lane: what the shared kernels of the rasteriser (project.inl,
// moving_camera.inl) are in a thread of a GPU, and in the emulation of one.
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>

#define SPIKED_INLINED
#if defined(__CUDACC__)
#define SPIKED_DEVICE __device__
#else
#define SPIKED_DEVICE
#endif

namespace spiked {
namespace {

constexpr int kLanes = 1;

struct Int {
    int32_t v;
    SPIKED_DEVICE int32_t& operator[](int) { return v; }
    SPIKED_DEVICE int32_t operator[](int) const { return v; }
};

struct Vec {
    float v;
    Vec() = default;
    SPIKED_DEVICE Vec(float x) : v(x) {}
    SPIKED_DEVICE float& operator[](int) { return v; }
    SPIKED_DEVICE float operator[](int) const { return v; }
    SPIKED_DEVICE Vec& operator+=(Vec b) { return v += b.v, *this; }
    SPIKED_DEVICE Vec& operator-=(Vec b) { return v -= b.v, *this; }
    SPIKED_DEVICE Vec& operator*=(Vec b) { return v *= b.v, *this; }
};

// As with vectors, true is -1.
SPIKED_DEVICE inline Int truth(bool b) { return {b ? -1 : 0}; }
SPIKED_DEVICE inline Int operator&(Int a, Int b) { return {a.v & b.v}; }
SPIKED_DEVICE inline Vec operator+(Vec a, Vec b) { return a.v + b.v; }
SPIKED_DEVICE inline Vec operator-(Vec a, Vec b) { return a.v - b.v; }
SPIKED_DEVICE inline Vec operator*(Vec a, Vec b) { return a.v * b.v; }
SPIKED_DEVICE inline Vec operator/(Vec a, Vec b) { return a.v / b.v; }
SPIKED_DEVICE inline Vec operator-(Vec a) { return -a.v; }
SPIKED_DEVICE inline Int operator<(Vec a, Vec b) { return truth(a.v < b.v); }
SPIKED_DEVICE inline Int operator<=(Vec a, Vec b) { return truth(a.v <= b.v); }
SPIKED_DEVICE inline Int operator>(Vec a, Vec b) { return truth(a.v > b.v); }
SPIKED_DEVICE inline Int operator>=(Vec a, Vec b) { return truth(a.v >= b.v); }
SPIKED_DEVICE inline Int operator==(Vec a, Vec b) { return truth(a.v == b.v); }

SPIKED_DEVICE inline Vec broadcast(float x) { return x; }
SPIKED_DEVICE inline Vec load(const float* p) { return *p; }
SPIKED_DEVICE inline void store(float* p, Vec v) { *p = v.v; }
SPIKED_DEVICE inline Vec min(Vec a, Vec b) { return a.v < b.v ? a.v : b.v; }
SPIKED_DEVICE inline Vec max(Vec a, Vec b) { return a.v > b.v ? a.v : b.v; }
SPIKED_DEVICE inline Vec sqrt(Vec a) { return sqrtf(a.v); }
SPIKED_DEVICE inline Vec clamp(Vec x, Vec low, Vec high) { return min(max(x, low), high); }
SPIKED_DEVICE inline Vec select(Int condition, Vec yes, Vec no) { return condition.v ? yes : no; }
SPIKED_DEVICE inline Int is_finite(Vec x) { return truth(x.v - x.v == 0.0f); }
SPIKED_DEVICE inline Vec exp2_fine(Vec x) { return exp2f(x.v); }
SPIKED_DEVICE inline Vec log2_fine(Vec x) { return log2f(x.v); }

}  // namespace
}  // namespace spiked
