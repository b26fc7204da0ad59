// How an image on the device is compared with spikes there; for `Device` see passes.inl.

namespace spiked {
namespace {

template <class Device>
struct Spikes final : public GpuSpikes {
    typename Device::template Buffer<uint8_t> bytes;
};

template <class Device>
struct Light final : public GpuLight {
    typename Device::template Buffer<float> factor, added;
};

template <class Device>
class ChargeComparer {
  public:
    explicit ChargeComparer(Device& device) : device_(device) {}

    // image [height][width][colours], depth [height][width].
    ChargeComparison compare(const PinholeF& camera, int colours, const float* image, const float* depth,
                             Spikes<Device>& spikes, Light<Device>& light, const ChargeLoss& loss) {
        const SpikeLayout& sensor = spikes.layout;
        const int rows = (sensor.height + loss.cell - 1) / loss.cell + 1;
        const int columns = (sensor.width + loss.cell - 1) / loss.cell + 1;
        const float* nodes = warp(camera, depth, spikes, loss, rows, columns);
        ChargeScene scene{};
        scene.spikes = sensor, scene.bytes = spikes.bytes.data(), scene.frames = spikes.frames;
        scene.nodes = nodes, scene.rows = rows, scene.columns = columns, scene.cell = loss.cell, scene.image = image;
        scene.width = camera.width, scene.height = camera.height, scene.colours = colours, scene.pixel = loss.pixel;
        scene.gain = light.factor.data(), scene.dark = light.dark ? light.added.data() : nullptr;
        scene.level = loss.level, scene.floor = loss.floor, scene.jitter = loss.jitter;
        scene.every = loss.every, scene.phase = loss.phase;
        const int64_t count = static_cast<int64_t>(camera.width) * camera.height * colours;
        const int pairs = ((sensor.height + 1) / 2 - loss.phase + loss.every - 1) / loss.every;
        const int64_t pixels = static_cast<int64_t>(2 * (pairs > 0 ? pairs : 0)) * sensor.width;
        const uint64_t blocks = blocks_of(pixels, CompareCharge::kThreads);
        int64_t* steps = steps_.grow(count);
        double *partial = partial_.grow(kChargeSums * blocks + 1), *totals = totals_.grow(kChargeSums);
        device_.run(Clear{steps, count}, blocks_of(count, Clear::kThreads));
        device_.run(CompareCharge{scene, pixels, residuals_.grow(spikes.frames * pixels + 1), steps, partial}, blocks);
        device_.run(SumBlocks{partial, static_cast<int>(blocks), kChargeSums, totals}, kChargeSums);
        float *raw = raw_.grow(count), *slope = slope_.grow(count);
        device_.run(MeanSlope{steps, totals, loss.floor, count, raw}, blocks_of(count, MeanSlope::kThreads));
        finish(camera, colours, loss, raw, slope);
        double sums[kChargeSums];
        device_.download(sums, totals, kChargeSums);
        device_.finish();
        values_ = count;
        return {sums[kLoss], sums[kCompared], sums[kChi2], sums[kIntervals], sums[kExpected], sums[kCounted]};
    }

    const float* slope() { return slope_.data(); }
    size_t values() const { return values_; }  // of the last image
    void raw_slope(float* out) {
        device_.download(out, raw_.data(), values_);
        device_.finish();
    }

  private:
    template <class T>
    using Buffer = typename Device::template Buffer<T>;

    const float* warp(const PinholeF& camera, const float* depth, const Spikes<Device>& spikes, const ChargeLoss& loss,
                      int rows, int columns) {
        const size_t pixels = static_cast<size_t>(camera.width) * camera.height, frames = spikes.frames;
        const DepthImage image{depth, camera.width, camera.height, loss.nearest};
        uint32_t *keys = keys_.grow(pixels), *order = order_.grow(pixels);
        uint32_t *sorted = sorted_.grow(pixels), *sorted_order = sorted_order_.grow(pixels);
        const uint64_t blocks = blocks_of(pixels, kValueThreads);
        device_.run(KeyDepths{image, keys, order}, blocks);
        device_.sort(keys, sorted, order, sorted_order, pixels, 32);
        float *median = median_.grow(1), *smooth = smooth_.grow(pixels);
        device_.run(MedianDepth{sorted, static_cast<int64_t>(pixels), median}, 1);
        const float shrink = static_cast<float>(camera.width) / static_cast<float>(spikes.layout.width);
        const int side = static_cast<int>(std::nearbyint(static_cast<float>(loss.cell) * shrink));
        device_.run(SmoothDepths{image, median, side > 1 ? side : 1, smooth}, blocks);
        const InverseDepths depths{
            smooth, camera.width, static_cast<float>(camera.width - 1), static_cast<float>(camera.height - 1),
            shrink, loss.nearest};
        const size_t nodes = frames * rows * columns;
        float* out = nodes_.grow(2 * nodes);
        device_.run(WarpNodes{depths, device_.upload(turn_, loss.turn, 9 * frames),
                              device_.upload(shift_, loss.shift, 3 * frames), spikes.frames, rows, columns,
                              static_cast<float>(loss.cell), out},
                    blocks_of(nodes, WarpNodes::kThreads));
        return out;
    }

    void finish(const PinholeF& camera, int colours, const ChargeLoss& loss, const float* raw, float* slope) {
        Blur blur{camera.width, camera.height, colours, {}};
        const int64_t count = static_cast<int64_t>(camera.width) * camera.height * colours;
        const uint64_t blocks = blocks_of(count, kValueThreads);
        if (loss.detail == 0) {
            device_.run(Scale{raw, count, loss.scale, slope}, blocks);
            return;
        }
        std::copy_n(loss.window, kDetailReach + 1, blur.window);
        float* rows = rows_.grow(count);
        device_.run(BlurRows{blur, raw, rows}, blocks);
        device_.run(AddDetail{blur, raw, rows, loss.detail, loss.scale, slope}, blocks);
    }

    Device& device_;
    size_t values_ = 0;
    Buffer<uint32_t> keys_, order_, sorted_, sorted_order_;
    Buffer<float> median_, smooth_, turn_, shift_, nodes_;
    Buffer<float> residuals_, raw_, rows_, slope_;
    Buffer<int64_t> steps_;
    Buffer<double> partial_, totals_;
};

}  // namespace
}  // namespace spiked
