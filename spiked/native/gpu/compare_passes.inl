// How an image on the device is compared with a frame there; for `Device` see passes.inl.

namespace spiked {
namespace {

template <class Device>
struct Frame final : public GpuFrame {
    typename Device::template Buffer<float> rates, deviation, windows;
    typename Device::template Buffer<uint8_t> channels;
};

// The gains of pixels, and what it needs to compare images with frames.
template <class Device>
class Comparer {
  public:
    explicit Comparer(Device& device) : device_(device) {}

    void set_gains(const float* gain, size_t pixels) {
        device_.upload(gain_, gain, pixels);
        device_.finish();
    }

    Compared pair(const float* rendered, Frame<Device>& frame, bool gains) {
        const size_t pixels = static_cast<size_t>(frame.width) * frame.height;
        return {frame.width,
                frame.height,
                static_cast<int>(frame.values / pixels),
                static_cast<int64_t>(frame.values),
                frame.mosaic,
                rendered,
                frame.rates.data(),
                frame.deviation.data(),
                gains ? gain_.data() : nullptr};
    }

    RateComparison compare(const Compared& image, const RateLoss& loss) {
        const int64_t count = image.values;
        const uint64_t blocks = blocks_of(count, kValueThreads);
        float *expected = expected_.grow(count), *slope = slope_.grow(count);
        double *partial = partial_.grow(kCompareSums * blocks), *totals = totals_.grow(kCompareSums + 1);
        device_.run(CompareRates{image, loss, expected, slope, partial}, blocks);
        device_.run(SumBlocks{partial, static_cast<int>(blocks), kCompareSums, totals}, kCompareSums);
        const float* similarity = loss.share > 0 ? compare_structure(image, loss, totals + kCompareSums) : nullptr;
        device_.run(MixSlopes{image, loss, similarity, slope}, blocks);
        double sums[kCompareSums + 1];
        device_.download(sums, totals, kCompareSums + (similarity ? 1 : 0));
        device_.finish();
        const double over = 1 / static_cast<double>(count), white = loss.white;
        return {sums[kSquares] * over / (white * white), similarity ? sums[kCompareSums] * over : 1,
                sums[kExpectedLight], sums[kObservedLight]};
    }

    const float* slope() { return slope_.data(); }

    void set_evidence(const float* xx, const float* xy, size_t pixels) {
        device_.upload(xx_, xx, pixels);
        device_.upload(xy_, xy, pixels);
        device_.finish();
    }

    void add_evidence(const Compared& image, float level, float model_error) {
        device_.run(AddEvidence{image, level, model_error, xx_.data(), xy_.data()},
                    blocks_of(image.values, AddEvidence::kThreads));
    }

    void evidence(float* xx, float* xy, size_t pixels) {
        device_.download(xx, xx_.data(), pixels);
        device_.download(xy, xy_.data(), pixels);
        device_.finish();
    }

  private:
    template <class T>
    using Buffer = typename Device::template Buffer<T>;

    // The gradient of the mean similarity, whose sum goes to `total`.
    const float* compare_structure(const Compared& image, const RateLoss& loss, double* total) {
        const int64_t count = image.values;
        const uint64_t blocks = blocks_of(image.width, kTile) * blocks_of(image.height, kTile) * image.colours;
        const float square = loss.white * loss.white;
        float *derivatives = derivatives_.grow(3 * count), *gradient = gradient_.grow(count);
        double* partial = structure_.grow(blocks);
        device_.run(CompareStructure{image,
                                     {image.width, image.height, 1e-4f * square, 9e-4f * square},
                                     expected_.data(),
                                     derivatives,
                                     partial},
                    blocks);
        device_.run(SumBlocks{partial, static_cast<int>(blocks), 1, total}, 1);
        device_.run(DifferentiateStructure{image, expected_.data(), derivatives, gradient}, blocks);
        return gradient;
    }

    Device& device_;
    Buffer<float> gain_, xx_, xy_;
    Buffer<float> expected_, slope_, derivatives_, gradient_;
    Buffer<double> partial_, structure_, totals_;
};

}  // namespace
}  // namespace spiked
