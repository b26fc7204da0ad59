// SPIKED_KERNEL(result, name, arguments), see instruction_sets.hpp.

// From the splats to the arrays of Prepared, a whole group at a time; beyond the count the last splat is repeated.
SPIKED_KERNEL(void, prepare,
              (const SplatArrays&, int first, int last, float* const mean[3], float* const spread[9],
               float* log2_opacity))
// Writes records[first..last) and keys (bits of z, or kCulled).
SPIKED_KERNEL(void, project,
              (const Prepared&, const PinholeF&, const View&, int count, int first, int last, ProjectedSplat* records,
               uint32_t* keys))
// Writes the pairs of records[first..last) to `out` as long as there is room for kSplatBatch times
// tiles_x * tiles_y + 4 more, counts them by splat and by tile, and returns the first rank that was left out.
// `columns` is scratch, 2 * kSplatBatch * (blocks in a column of tiles + kGroup) integers.
SPIKED_KERNEL(int, intersect_tiles,
              (const ProjectedSplat* records, int first, int last, const PinholeF&, int32_t* columns,
               const TilePairList& out))
SPIKED_KERNEL(void, forward,
              (const Tile&, int colours, const float background[3], const Planes&, const TileState&, TileImage*))
SPIKED_KERNEL(void, store_tile,
              (const Tile&, const TileImage*, int colours, const Planes&, float* values, float* alpha, float* depth))
// d_values [height][width] or [height][width][3]; a slot for each entry of slot_floats(colours) floats.
SPIKED_KERNEL(void, backward,
              (const Tile&, int colours, const float* d_values, const Planes&, const TileState&, float* slots))
// As project, for a moving camera.
SPIKED_KERNEL(void, project_moving,
              (const Prepared&, const PinholeF&, const SubFrame&, int count, int first, int last,
               ProjectedSplat* records, Motion* motions, uint32_t* keys))
// Adds one view's gradients of the group [first, first + kGroup); sums [kSums][kGroup] are zero where not visible.
// pose: sums of 3 of rotation, then 3 of the mean.
SPIKED_KERNEL(void, unproject,
              (const Prepared&, const PinholeF&, const View&, int first, const float* sums, const uint8_t* visible,
               int colours, const SplatGradients&, double pose[6]))
// As unproject, for a moving camera, by the poses at both ends of the sub-frame.
SPIKED_KERNEL(void, unproject_moving,
              (const Prepared&, const PinholeF&, const SubFrame&, int first, const float* sums, const uint8_t* visible,
               int colours, const SplatGradients&, double pose_begin[6], double pose_end[6]))
// Sums over `count` pixels' windows of their weights in a sub-frame, and of those times the square of the share of
// the sub-frame that they cover; and the farthest time from its middle.
SPIKED_KERNEL(void, cover, (const Planes&, int64_t count, double* weight, double* square, float* time_reach))
// From the gradients of spread, log opacity and so on to those of the parameters, for splats [first, last); zeros
// where out.radius_px is 0. share_scale multiplies the contributions.
SPIKED_KERNEL(void, finish,
              (const SplatArrays&, const Prepared&, const SplatGradients&, int first, int last, float share_scale,
               const GradientArrays& out))
// One step over [rows][columns <= 4]; correction is the bias correction of a row, 0 to leave it as it is.
SPIKED_KERNEL(void, adam,
              (const AdamRates&, int rows, int columns, const float* correction, const float* gradient,
               float* parameter, float* first, float* second))
// From gradients by the means of splats [first, last) to those by steps along their axes; and such steps.
SPIKED_KERNEL(void, slopes_along_axes, (const SplatAxes&, int first, int last, const float* by_means, float* by_axes))
SPIKED_KERNEL(void, move_along_axes, (const SplatAxes&, int first, int last, const float* steps, float* means))
// Structural similarity of rows [first, last) in three passes: the rows of planes[0..4], from those what planes[5..7]
// hold and sums [height], from those the gradient. Planes have kSsimMargin rows of zeros above and below; scratch has
// ssim_scratch(width) floats.
SPIKED_KERNEL(void, ssim_blur,
              (const SsimImage&, const float* rendered, const float* target, int first, int last, float* scratch,
               float* const planes[8]))
SPIKED_KERNEL(void, ssim_compare,
              (const SsimImage&, int first, int last, float* scratch, float* const planes[8], double* sums))
SPIKED_KERNEL(void, ssim_gradient,
              (const SsimImage&, const float* rendered, const float* target, int first, int last, float* scratch,
               float* const planes[8], float* d_rendered))
