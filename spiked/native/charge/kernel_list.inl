// SPIKED_KERNEL(result, name, arguments), see instruction_sets.hpp.

// Adds rows [first, last) to the sums and to job.slope; `lines` [frames][columns][2] and `scratch` belong to the call.
SPIKED_KERNEL(void, charge, (const ChargeJob&, int64_t first, int64_t last, float* lines, void* scratch, ChargeSums&))
// Bytes of scratch.
SPIKED_KERNEL(int64_t, charge_scratch, ())
