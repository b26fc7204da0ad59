// SPIKED_KERNEL(result, name, arguments), see instruction_sets.hpp.

// The spike-aligned window of every pixel.
SPIKED_KERNEL(void, window, (const WindowJob&))
// One row to eight pixels a byte, 0 or 1.
SPIKED_KERNEL(void, unpack, (const uint8_t* row, size_t bytes, bool msb, uint8_t* pixels))
