#pragma once

namespace spiked {

constexpr int kMaxChargeFrames = 64;
constexpr int kLeastChargeFrames = 4;  // a pixel within the image for fewer frames is not used

}  // namespace spiked
