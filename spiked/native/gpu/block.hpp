// A block of threads, as kernels are written for it: on a GPU a thread each, in the emulation one after the other.
//
// A kernel is a struct of plain data with kThreads and operator()(Block<kThreads>). In it, what every thread does
// stands in each(), what a thread keeps from one each() to the next in a PerThread, and what the block shares in
// SPIKED_SHARED variables. Threads see each other's writes after sync().
#pragma once
#include "lane.hpp"

#if defined(__CUDACC__)
#define SPIKED_SHARED __shared__
#else
#define SPIKED_SHARED
#endif

namespace spiked {
namespace {

constexpr int kWarp = 32;

// Blocks of a grid that has so many threads at least.
inline uint64_t blocks_of(uint64_t threads, int of_block) { return (threads + of_block - 1) / of_block; }

// Adds to what other threads add to, too. Whole numbers: their order changes nothing.
SPIKED_DEVICE inline void add_whole(int64_t* sum, int64_t value) {
#if defined(__CUDACC__)
    atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(value));
#else
    *sum += value;
#endif
}

template <class T, int Threads>
struct PerThread {
#if defined(__CUDACC__)
    T value;
    SPIKED_DEVICE T& operator[](int) { return value; }
#else
    T values[Threads];
    T& operator[](int thread) { return values[thread]; }
#endif
};

template <class T, int N>
struct Sums {
    T of[N];
};

template <int Threads>
struct Block {
    static constexpr int kWarps = Threads / kWarp;
    static_assert(Threads % kWarp == 0, "blocks are whole warps");
    uint32_t index;  // of the block in its grid

    // f(thread) for all threads.
    template <class F>
    SPIKED_DEVICE void each(F f) const {
#if defined(__CUDACC__)
        f(static_cast<int>(threadIdx.x));
#else
        for (int thread = 0; thread < Threads; ++thread) f(thread);
#endif
    }

    SPIKED_DEVICE void sync() const {
#if defined(__CUDACC__)
        __syncthreads();
#endif
    }

    // Whether f(thread) is true of any; a sync().
    template <class F>
    SPIKED_DEVICE bool any(F f) const {
#if defined(__CUDACC__)
        return __syncthreads_or(f(static_cast<int>(threadIdx.x)));
#else
        for (int thread = 0; thread < Threads; ++thread)
            if (f(thread)) return true;
        return false;
#endif
    }

    // out[warp * stride + k] = the sum over the warp's threads of values[thread].of[k], in a fixed order. Where `some`
    // is false of all threads of a warp, all values are zero, and are not added up. Needs a sync() before it is read.
    template <class T, int N>
    SPIKED_DEVICE void warp_sums(PerThread<Sums<T, N>, Threads>& values, PerThread<bool, Threads>& some, T* out,
                                 int stride) const {
#if defined(__CUDACC__)
        const int lane = threadIdx.x % kWarp;
        out += threadIdx.x / kWarp * stride;
        if (!__any_sync(~0u, some.value)) {
            for (int k = lane; k < N; k += kWarp) out[k] = 0;
            return;
        }
        static_assert(N <= kWarp && (N & (N - 1)) == 0, "halved at every step");
        T(&v)[N] = values.value.of;
        int kept = 0;
        fold<N / 2>(v, lane, kept);
#pragma unroll
        for (int apart = N; apart < kWarp; apart *= 2) v[0] += __shfl_xor_sync(~0u, v[0], apart);
        if (lane < N) out[kept] = v[0];
#else
        for (int warp = 0; warp < kWarps; ++warp)
            for (int k = 0; k < N; ++k) {
                T sum = 0;
                for (int i = 0; i < kWarp; ++i) sum += values[warp * kWarp + i].of[k];
                out[warp * stride + k] = sum;
            }
        static_cast<void>(some);
#endif
    }

    // out[k] = the same over the whole block, by way of what its warps share, [kWarps][N].
    template <class T, int N>
    SPIKED_DEVICE void sums(PerThread<Sums<T, N>, Threads>& values, PerThread<bool, Threads>& some, T* shared,
                            T* out) const {
        warp_sums(values, some, shared, N);
        sync();
        each([&](int thread) {
            if (thread >= N) return;
            T sum = 0;
            for (int warp = 0; warp < kWarps; ++warp) sum += shared[warp * N + thread];
            out[thread] = sum;
        });
    }

#if defined(__CUDACC__)
  private:
    // A lane gives half of its 2 Half sums to the one on the other side and goes on with the other half, from `kept`
    // on.
    template <int Half, class T, int N>
    SPIKED_DEVICE static void fold(T (&v)[N], int lane, int& kept) {
        if constexpr (Half > 0) {
            const bool upper = lane & Half;
            if (upper) kept |= Half;
#pragma unroll
            for (int k = 0; k < Half; ++k) {
                const T given = upper ? v[k] : v[k + Half], own = upper ? v[k + Half] : v[k];
                v[k] = own + __shfl_xor_sync(~0u, given, Half);
            }
            fold<Half / 2>(v, lane, kept);
        }
    }
#endif
};

}  // namespace
}  // namespace spiked
