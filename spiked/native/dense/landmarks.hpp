// The normal equations of a landmark in one view: rows of derivatives by the landmark, by the pose, and the error.
#pragma once

namespace spiked {

constexpr int kLandmark = 3, kPose = 6;
constexpr int kRow = kLandmark + kPose + 1;

}  // namespace spiked
