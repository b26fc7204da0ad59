// The marks of functions that a GPU runs as well, where neither simd.hpp nor native/gpu/lane.hpp has set them before.
#pragma once

#if !defined(SPIKED_DEVICE)
#define SPIKED_DEVICE
#endif
#if !defined(SPIKED_INLINED)
#define SPIKED_INLINED
#endif
