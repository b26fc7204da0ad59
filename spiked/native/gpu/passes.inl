// The passes of the renderer: kernels in their order. `Device` has memory and runs kernels:
//
//   template <class T> class Buffer { T* grow(size_t count); T* data(); void swap(Buffer&); };
//       Its contents are lost when it grows.
//   template <class T> const T* upload(Buffer<T>&, const T* from, size_t count);
//   template <class T> void put(T* to, const T* from, size_t count);
//       As upload, to memory that is there.
//   template <class T> void download(T* to, const T* from, size_t count);
//       Done after finish().
//   void finish();
//   template <class Kernel> void run(const Kernel&, uint64_t blocks);
//   void sort(const uint32_t* keys, uint32_t* sorted_keys, const uint32_t* values, uint32_t* sorted_values,
//             size_t count, int bits);
//       Equal keys keep their order.
//   void add_up(const uint64_t* counts, uint64_t* sums, size_t count);
//       sums[i] of those before i.

#include <algorithm>
#include <stdexcept>
#include <type_traits>

namespace spiked {
namespace {

constexpr uint64_t kMaxPairs = 1u << 30;  // of a splat and a tile

// call(std::true_type or std::false_type), by the value.
template <class Call>
void choose(bool value, Call call) {
    if (value) {
        call(std::true_type{});
    } else {
        call(std::false_type{});
    }
}

template <class Device>
class Resident final : public GpuScene {
  public:
    template <class T>
    using Buffer = typename Device::template Buffer<T>;

    void set(const SplatArrays& given, const float* first, const float* second, const uint32_t* taken) override {
        count_ = given.count, colours_ = given.colours;
        const size_t n = count_;
        device_.upload(means_, given.means, 3 * n);
        device_.upload(quats_, given.quats, 4 * n);
        device_.upload(log_scales_, given.log_scales, 3 * n);
        device_.upload(opacity_logits_, given.opacity_logits, n);
        device_.upload(colour_, given.colour, colours_ * n);
        device_.upload(first_, first, (11 + colours_) * n);
        device_.upload(second_, second, (11 + colours_) * n);
        device_.upload(taken_, taken, n);
        device_.finish();
    }

    void get(float* means, float* quats, float* log_scales, float* opacity_logits, float* colours, float* first,
             float* second, uint32_t* taken) override {
        const size_t n = count_;
        device_.download(means, means_.data(), 3 * n);
        device_.download(quats, quats_.data(), 4 * n);
        device_.download(log_scales, log_scales_.data(), 3 * n);
        device_.download(opacity_logits, opacity_logits_.data(), n);
        device_.download(colours, colour_.data(), colours_ * n);
        device_.download(first, first_.data(), (11 + colours_) * n);
        device_.download(second, second_.data(), (11 + colours_) * n);
        device_.download(taken, taken_.data(), n);
        device_.finish();
    }

    void select(const uint32_t* rows, size_t count) override {
        rearrange(rows, count);
        device_.finish();
    }

    void join(const SplatArrays& more) override {
        const size_t n = count_, m = more.count;
        std::vector<uint32_t> rows(n + m, kNoRow);
        for (size_t i = 0; i < n; ++i) rows[i] = static_cast<uint32_t>(i);
        rearrange(rows.data(), rows.size());
        device_.put(means_.data() + 3 * n, more.means, 3 * m);
        device_.put(quats_.data() + 4 * n, more.quats, 4 * m);
        device_.put(log_scales_.data() + 3 * n, more.log_scales, 3 * m);
        device_.put(opacity_logits_.data() + n, more.opacity_logits, m);
        device_.put(colour_.data() + colours_ * n, more.colour, colours_ * m);
        device_.finish();
    }

    void opacity_logits(float* out) override {
        device_.download(out, opacity_logits_.data(), count_);
        device_.finish();
    }

    SplatArrays arrays() {
        return {count_,        colours_, means_.data(), quats_.data(), log_scales_.data(), opacity_logits_.data(),
                colour_.data()};
    }

    Descend step(const GradientArrays& gradients, const DescentRates& rates) {
        return {count_,         colours_,  means_.data(), quats_.data(),  log_scales_.data(), opacity_logits_.data(),
                colour_.data(), gradients, first_.data(), second_.data(), taken_.data(),      rates};
    }

  private:
    void rearrange(const uint32_t* given, size_t count) {
        const uint32_t* rows = device_.upload(rows_, given, count);
        const auto rearranged = [&](auto& array, auto& spare, int columns) {
            using Kernel = TakeRows<std::remove_reference_t<decltype(*array.data())>>;
            const uint64_t elements = static_cast<uint64_t>(count) * columns;
            device_.run(Kernel{array.data(), spare.grow(elements), rows, elements, columns},
                        blocks_of(elements, Kernel::kThreads));
            array.swap(spare);
        };
        rearranged(means_, spare_, 3);
        rearranged(quats_, spare_, 4);
        rearranged(log_scales_, spare_, 3);
        rearranged(opacity_logits_, spare_, 1);
        rearranged(colour_, spare_, colours_);
        rearranged(first_, spare_, 11 + colours_);
        rearranged(second_, spare_, 11 + colours_);
        rearranged(taken_, spare_taken_, 1);
        count_ = static_cast<int>(count);
    }

    Device device_;
    Buffer<float> means_, quats_, log_scales_, opacity_logits_, colour_, first_, second_, spare_;
    Buffer<uint32_t> taken_, spare_taken_, rows_;
};

template <class Device>
class Passes final : public GpuRenderer {
  public:
    explicit Passes(const PinholeF& camera) : GpuRenderer(camera), comparer_(device_), charge_(device_) {}

    const char* instructions() const override { return Device::kName; }

    void forward(const SplatArrays& splats, const Views& views, const float background[3], float* values, float* alpha,
                 float* depth) override {
        start();
        take(splats);
        show(views, background, values, alpha, depth);
    }

    void forward(GpuScene& scene, const Views& views, const float background[3], float* values, float* alpha,
                 float* depth) override {
        start();
        splats_ = static_cast<Resident<Device>&>(scene).arrays();
        show(views, background, values, alpha, depth);
    }

    RateComparison compare(GpuScene& scene, GpuFrame& given, const Views& poses, const float background[3],
                           const RateLoss& loss) override {
        start();
        auto& frame = static_cast<Frame<Device>&>(given);
        splats_ = static_cast<Resident<Device>&>(scene).arrays();
        const float* windows = frame.moving ? frame.windows.data() : nullptr;
        render(poses, {nullptr, windows, frame.mosaic ? frame.channels.data() : nullptr}, background);
        const RateComparison made = comparer_.compare(comparer_.pair(image_.data(), frame, loss.gains), loss);
        slope_ = comparer_.slope();
        compared_ = true;
        return made;
    }

    ChargeComparison compare_charge(GpuScene& scene, GpuSpikes& spikes, GpuLight& light, const Views& pose,
                                    const float background[3], const ChargeLoss& loss) override {
        start();
        splats_ = static_cast<Resident<Device>&>(scene).arrays();
        render(pose, {}, background);
        const float *image = image_.data(), *depth = image + shown() + pixels();
        const ChargeComparison made =
            charge_.compare(camera_, splats_.colours, image, depth, static_cast<Spikes<Device>&>(spikes),
                            static_cast<Light<Device>&>(light), loss);
        slope_ = charge_.slope();
        compared_ = true;
        return made;
    }

    std::unique_ptr<GpuSpikes> spikes(const SpikeLayout& layout, const uint8_t* bytes, int frames) override {
        auto made = std::make_unique<Spikes<Device>>();
        made->layout = layout, made->frames = frames;
        device_.upload(made->bytes, bytes, static_cast<size_t>(frames) * layout.height * layout.row_stride);
        device_.finish();
        return made;
    }

    std::unique_ptr<GpuLight> light(int width, int height, const float* gain, const float* dark) override {
        auto made = std::make_unique<Light<Device>>();
        made->width = width, made->height = height, made->dark = dark != nullptr;
        device_.upload(made->factor, gain, static_cast<size_t>(width) * height);
        if (dark) device_.upload(made->added, dark, static_cast<size_t>(width) * height);
        device_.finish();
        return made;
    }

    void charge_slope(float* out) override { charge_.raw_slope(out); }
    size_t charge_values() const override { return charge_.values(); }

    std::unique_ptr<GpuFrame> frame(const FrameArrays& given) override {
        auto frame = std::make_unique<Frame<Device>>();
        frame->width = camera_.width, frame->height = camera_.height, frame->values = given.values;
        frame->mosaic = given.channels != nullptr, frame->moving = given.windows != nullptr;
        device_.upload(frame->rates, given.rates, given.values);
        device_.upload(frame->deviation, given.deviation, given.values);
        if (frame->moving) device_.upload(frame->windows, given.windows, 2 * pixels());
        if (frame->mosaic) device_.upload(frame->channels, given.channels, pixels());
        device_.finish();
        return frame;
    }

    void set_gains(const float* gain) override {
        comparer_.set_gains(gain, pixels());
        has_gains_ = true;
    }

    void slope(float* out) override {
        device_.download(out, slope_, shown());
        device_.finish();
    }

    void add_evidence(GpuFrame& frame, float level, float model_error) override {
        comparer_.add_evidence(comparer_.pair(image_.data(), static_cast<Frame<Device>&>(frame), true), level,
                               model_error);
    }

    void set_evidence(const float* xx, const float* xy) override {
        comparer_.set_evidence(xx, xy, pixels());
        has_evidence_ = true;
    }

    void evidence(float* xx, float* xy) override { comparer_.evidence(xx, xy, pixels()); }

    void backward(const float* d_values, const GradientArrays& out) override {
        differentiate(d_values);
        const size_t n = splats_.count;
        device_.download(out.means, gradients_.means, 3 * n);
        device_.download(out.quats, gradients_.quats, 4 * n);
        device_.download(out.log_scales, gradients_.log_scales, 3 * n);
        device_.download(out.opacity_logits, gradients_.opacity_logits, n);
        device_.download(out.colour, gradients_.colour, splats_.colours * n);
        device_.download(out.contribution, gradients_.contribution, n);
        device_.download(out.radius_px, gradients_.radius_px, n);
        std::vector<double> sums(static_cast<size_t>(poses_) * 6);
        device_.download(sums.data(), by_poses_.data(), sums.size());
        device_.finish();
        for (int i = 0; i < poses_; ++i)
            for (int k = 0; k < 3; ++k) {
                out.rotation[3 * i + k] = sums[6 * i + k];
                out.centre[3 * i + k] = -sums[6 * i + 3 + k];
            }
    }

    void descend(const float* d_values, GpuScene& scene, const DescentRates& rates) override {
        differentiate(d_values);
        device_.run(static_cast<Resident<Device>&>(scene).step(gradients_, rates),
                    blocks_of(splats_.count, Descend::kThreads));
        device_.finish();
    }

    std::unique_ptr<GpuScene> scene() const override { return std::make_unique<Resident<Device>>(); }

  private:
    template <class T>
    using Buffer = typename Device::template Buffer<T>;

    // Planes on the device, see Views; windows [2][height][width].
    struct DevicePlanes {
        const float *weights, *windows;
        const uint8_t* channels;
    };

    // Until an image is done there is none.
    void start() {
        poses_ = 0;
        compared_ = false;
    }

    void show(const Views& views, const float background[3], float* values, float* alpha, float* depth) {
        const int sub_poses = views.start ? views.count - 1 : views.count;
        DevicePlanes planes{};
        if (views.weights) planes.weights = device_.upload(weights_, views.weights, sub_poses * pixels());
        if (views.start) planes.windows = device_.upload(weights_, views.start, 2 * pixels());
        if (views.channels) planes.channels = device_.upload(channels_, views.channels, pixels());
        render(views, planes, background);
        const float* image = image_.data();
        device_.download(values, image, shown());
        device_.download(alpha, image + shown(), pixels());
        device_.download(depth, image + shown() + pixels(), pixels());
        device_.finish();
    }

    void render(const Views& poses, const DevicePlanes& planes, const float background[3]) {
        take(poses, planes);
        choose(camera_.lens != 0, [&](auto bent) { choose(moving_, [&](auto moving) { project<bent, moving>(); }); });
        list_pairs();
        choose(splats_.colours == 3, [&](auto coloured) {
            choose(moving_, [&](auto moving) { composite<coloured ? 3 : 1, moving>(background); });
        });
        poses_ = poses.count;
        mosaic_ = planes.channels != nullptr;
    }

    // The gradients of the last image, which stay on the device; d_values: null for those of its comparison.
    void differentiate(const float* d_values) {
        const float* slopes = d_values ? device_.upload(d_values_, d_values, shown()) : slope_;
        float* slots = slots_.grow(static_cast<size_t>(pairs_) * slot_floats(splats_.colours, moving_) + 1);
        choose(splats_.colours == 3, [&](auto coloured) {
            choose(moving_, [&](auto moving) {
                device_.run(Backward<coloured ? 3 : 1, moving>{tiles_, states_, slopes, slots},
                            static_cast<uint64_t>(sub_poses_) * tiles());
            });
        });
        choose(camera_.lens != 0, [&](auto bent) { choose(moving_, [&](auto moving) { unproject<bent, moving>(); }); });
    }

    int tiles() const { return camera_.tiles_x * camera_.tiles_y; }
    size_t pixels() const { return static_cast<size_t>(camera_.width) * camera_.height; }
    size_t shown() const { return pixels() * (tiles_.channels ? 1 : splats_.colours); }  // values of the image
    size_t records() const { return static_cast<size_t>(splats_.count) * sub_poses_; }

    // Brings the splats to the device.
    void take(const SplatArrays& splats) {
        const size_t n = splats.count;
        splats_ = {splats.count,
                   splats.colours,
                   device_.upload(means_, splats.means, 3 * n),
                   device_.upload(quats_, splats.quats, 4 * n),
                   device_.upload(log_scales_, splats.log_scales, 3 * n),
                   device_.upload(opacity_logits_, splats.opacity_logits, n),
                   device_.upload(colours_, splats.colour, splats.colours * n)};
    }

    // Brings poses to the device.
    void take(const Views& given, const DevicePlanes& planes) {
        const size_t n = splats_.count;
        moving_ = planes.windows != nullptr;
        sub_poses_ = moving_ ? given.count - 1 : given.count;
        std::vector<View> poses(given.count);
        for (int i = 0; i < given.count; ++i) poses[i] = view_of(given.rotations + 9 * i, given.centres + 3 * i);
        tiles_ = {};
        tiles_.camera = camera_;
        tiles_.sub_poses = sub_poses_;
        tiles_.weights = planes.weights;
        tiles_.channels = planes.channels;
        tiles_.begin = planes.windows;
        tiles_.end = moving_ ? planes.windows + pixels() : nullptr;
        scene_.camera = camera_;
        scene_.splats = splats_;
        scene_.poses = {device_.upload(views_, poses.data(), poses.size()), sub_frames_.grow(sub_poses_), sub_poses_};
        Prepare prepare{splats_, {}, {}, nullptr};
        float* at = prepared_.grow(13 * n);
        for (int k = 0; k < 3; ++k, at += n) scene_.prepared.mean[k] = prepare.mean[k] = at;
        for (int k = 0; k < 9; ++k, at += n) scene_.prepared.spread[k] = prepare.spread[k] = at;
        scene_.prepared.log2_opacity = prepare.log2_opacity = at;
        device_.run(prepare, blocks_of(n, Prepare::kThreads));
        if (moving_)
            device_.run(SetSubFrames{scene_.poses, tiles_.begin, tiles_.end, static_cast<int64_t>(pixels())},
                        sub_poses_);
    }

    template <bool Bent, bool Moving>
    void project() {
        const Project<Bent, Moving> kernel{scene_, records_.grow(records()),
                                           Moving ? motions_.grow(records()) : nullptr, keys_.grow(records()),
                                           order_.grow(records())};
        device_.run(kernel, blocks_of(records(), kernel.kThreads));
        tiles_.records = kernel.records;
        tiles_.motions = kernel.motions;
    }

    // Lists the splats of every tile in order of depth, equal depths by number: they are sorted by depth, their pairs
    // are listed in that order, and then sorted by tile.
    void list_pairs() {
        const size_t count = records();
        if (count >= kCulled) throw std::runtime_error("too many splats and poses for one render");
        uint32_t *sorted = sorted_keys_.grow(count), *order = sorted_order_.grow(count);
        device_.sort(keys_.data(), sorted, order_.data(), order, count, 32);
        uint64_t *reached = counts_.grow(count + 1), *first = first_pairs_.grow(count + 1);
        device_.run(CountTiles{camera_, tiles_.records, sorted, order, static_cast<uint32_t>(count), reached},
                    blocks_of(count + 1, CountTiles::kThreads));
        device_.add_up(reached, first, count + 1);
        uint64_t pairs = 0;
        device_.download(&pairs, first + count, 1);
        device_.finish();
        if (pairs > kMaxPairs)
            throw std::runtime_error(
                "the splats reach more than 2^30 tiles together: render fewer poses or a smaller image");
        pairs_ = static_cast<uint32_t>(pairs);
        const uint32_t all_tiles = static_cast<uint32_t>(sub_poses_) * tiles();
        device_.run(
            ListPairs{camera_, tiles_.records, order, first, static_cast<uint32_t>(count),
                      static_cast<uint32_t>(splats_.count), pair_tiles_.grow(pairs_ + 1), pair_.grow(pairs_ + 1),
                      pair_record_.grow(pairs_ + 1), first_of_record_.grow(count), pairs_of_record_.grow(count)},
            blocks_of(count, ListPairs::kThreads));
        int bits = 1;
        while (all_tiles >> bits) ++bits;
        uint32_t *by_tile = sorted_tiles_.grow(pairs_ + 1), *listed = sorted_pairs_.grow(pairs_ + 1);
        device_.sort(pair_tiles_.data(), by_tile, pair_.data(), listed, pairs_, bits);
        uint32_t* start = tile_start_.grow(all_tiles + 1);
        device_.run(FindTiles{by_tile, pairs_, all_tiles, start},
                    blocks_of(static_cast<uint64_t>(pairs_) + 1, FindTiles::kThreads));
        tiles_.start = start;
        tiles_.pairs = listed;
        tiles_.pair_record = pair_record_.data();
    }

    template <int C, bool Moving>
    void composite(const float background[3]) {
        const uint64_t all_tiles = static_cast<uint64_t>(sub_poses_) * tiles();
        const size_t kept = all_tiles * kTilePixels;
        float* at = state_.grow((C + 2) * kept);
        states_ = {};
        for (int k = 0; k < C; ++k, at += kept) states_.colour[k] = at;
        states_.transmittance = at;
        states_.depth = at + kept;
        states_.end = ends_.grow(kept);
        device_.run(Forward<C, Moving>{tiles_, states_, {background[0], background[1], background[2]}}, all_tiles);
        float* image = image_.grow(shown() + 2 * pixels());
        device_.run(Combine<C, Moving>{tiles_, states_, image, image + shown(), image + shown() + pixels()}, tiles());
    }

    template <bool Bent, bool Moving>
    void unproject() {
        using Kernel = Unproject<Bent, Moving>;
        const size_t n = splats_.count, c = splats_.colours;
        float* at = gradient_.grow(n * (13 + c));
        const auto part = [&](float*& array, size_t columns) { array = at, at += n * columns; };
        GradientArrays& out = gradients_;
        part(out.means, 3), part(out.quats, 4), part(out.log_scales, 3), part(out.opacity_logits, 1);
        part(out.colour, c), part(out.contribution, 1), part(out.radius_px, 1);
        const uint64_t count = blocks_of(n, Kernel::kThreads);
        double* partial = partial_.grow(count * poses_ * 6 + 1);
        device_.run(Kernel{scene_, first_of_record_.data(), pairs_of_record_.data(), keys_.data(), tiles_.records,
                           slots_.data(), slot_floats(splats_.colours, Moving), out, partial, poses_},
                    count);
        double* by_poses = by_poses_.grow(static_cast<size_t>(poses_) * 6);
        device_.run(SumBlocks{partial, static_cast<int>(count), poses_ * 6, by_poses},
                    static_cast<uint64_t>(poses_) * 6);
    }

    Device device_;
    Comparer<Device> comparer_;
    ChargeComparer<Device> charge_;
    const float* slope_ = nullptr;  // by the image of the last comparison
    bool moving_ = false;
    int sub_poses_ = 0;  // or sub-frames
    uint32_t pairs_ = 0;
    Scene scene_{};
    Tiles tiles_{};
    States states_{};
    GradientArrays gradients_{};

    Buffer<float> means_, quats_, log_scales_, opacity_logits_, colours_, weights_, prepared_;
    Buffer<uint8_t> channels_;
    Buffer<View> views_;
    Buffer<SubFrame> sub_frames_;
    Buffer<ProjectedSplat> records_;  // [sub-poses][splats], as the next four
    Buffer<Motion> motions_;
    Buffer<uint32_t> keys_, order_, sorted_keys_, sorted_order_;
    Buffer<uint64_t> counts_, first_pairs_;  // by depth
    Buffer<uint32_t> pair_tiles_, pair_, pair_record_, sorted_tiles_, sorted_pairs_, tile_start_;
    Buffer<uint32_t> first_of_record_, pairs_of_record_;
    Buffer<float> state_;
    Buffer<uint32_t> ends_;
    Buffer<float> image_, d_values_, slots_, gradient_;
    Buffer<double> partial_, by_poses_;
};

}  // namespace
}  // namespace spiked
