// The part of the ring that several processes access at once: lock-free atomics in shared memory.
//
// There are no locks: a process that is killed between any two instructions blocks no other process.
#pragma once

#include <linux/futex.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <cerrno>
#include <climits>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <optional>
#include <type_traits>

namespace spiked {

static_assert(std::atomic<uint64_t>::is_always_lock_free && std::atomic<uint32_t>::is_always_lock_free,
              "atomics that hide a lock cannot be shared between processes");

// The latest value of a T, with one writing process and any number of readers.
// The new value is written to the copy that is not current, then the version selects it. The value is never torn, even
// if the writer is killed half-way. A reader repeats only if the writer has published twice meanwhile.
template <class T>
class DoubleBuffer {
    static_assert(std::is_trivially_copyable_v<T> && sizeof(T) % 8 == 0);
    static constexpr size_t words = sizeof(T) / 8;
    using Words = std::array<uint64_t, words>;

    std::atomic<uint64_t> version_;
    std::atomic<uint64_t> copies_[2][words];

  public:
    void publish(const T& value) {
        const uint64_t next = version_.load(std::memory_order_relaxed) + 1;
        Words source;
        std::memcpy(source.data(), &value, sizeof(T));
        // Orders the stores below after the previous version: a reader that sees one of them sees that version, too.
        std::atomic_thread_fence(std::memory_order_release);
        for (size_t i = 0; i < words; ++i) copies_[next & 1][i].store(source[i], std::memory_order_relaxed);
        version_.store(next, std::memory_order_release);
    }

    T read() const {
        for (;;) {
            const uint64_t before = version_.load(std::memory_order_acquire);
            Words target;
            for (size_t i = 0; i < words; ++i) target[i] = copies_[before & 1][i].load(std::memory_order_relaxed);
            std::atomic_thread_fence(std::memory_order_acquire);
            if (version_.load(std::memory_order_relaxed) == before) {
                T value;
                std::memcpy(static_cast<void*>(&value), target.data(), sizeof(T));
                return value;
            }
        }
    }
};

// One position of the log: frames in a slot, or a loss.
struct Entry {
    int64_t first = 0;
    int64_t count = 0;
    int64_t cause = 0;  // 0: frames; otherwise the number of the cause of a loss
    int64_t slot = 0;   // absolute number of the slot with the frames; of a loss, the number of the next one
};

// A position of the log with a sequence lock. The sequence number is 2 * position + 2 while the entry is valid.
class LogPlace {
    std::atomic<uint64_t> sequence_;
    std::atomic<int64_t> first_, count_, cause_, slot_;

  public:
    void write(uint64_t position, const Entry& entry) {
        sequence_.store(2 * position + 1, std::memory_order_relaxed);
        std::atomic_thread_fence(std::memory_order_release);
        first_.store(entry.first, std::memory_order_relaxed);
        count_.store(entry.count, std::memory_order_relaxed);
        cause_.store(entry.cause, std::memory_order_relaxed);
        slot_.store(entry.slot, std::memory_order_relaxed);
        sequence_.store(2 * position + 2, std::memory_order_release);
    }

    // The entry of that position, or nothing if it is overwritten or not yet there.
    std::optional<Entry> read(uint64_t position) const {
        if (sequence_.load(std::memory_order_acquire) != 2 * position + 2) return std::nullopt;
        Entry entry;
        entry.first = first_.load(std::memory_order_relaxed);
        entry.count = count_.load(std::memory_order_relaxed);
        entry.cause = cause_.load(std::memory_order_relaxed);
        entry.slot = slot_.load(std::memory_order_relaxed);
        std::atomic_thread_fence(std::memory_order_acquire);
        if (sequence_.load(std::memory_order_relaxed) != 2 * position + 2) return std::nullopt;
        return entry;
    }
};

// Wakes processes by a futex on a shared word. The kernel removes a waiter that dies. A ring() between reading the
// value and sleeping changes the word, so it is never missed.
class Bell {
    std::atomic<uint32_t> word_;

    uint32_t* address() { return reinterpret_cast<uint32_t*>(&word_); }

  public:
    uint32_t value() const { return word_.load(std::memory_order_acquire); }

    void ring() {
        word_.fetch_add(1, std::memory_order_release);
        syscall(SYS_futex, address(), FUTEX_WAKE, INT_MAX, nullptr, nullptr, 0);
    }

    // True if the bell rang since `seen` was read; false after the timeout or a signal.
    bool wait(uint32_t seen, double timeout_s) {
        timespec timeout;
        timeout.tv_sec = static_cast<time_t>(timeout_s);
        timeout.tv_nsec = static_cast<long>((timeout_s - static_cast<double>(timeout.tv_sec)) * 1e9);
        syscall(SYS_futex, address(), FUTEX_WAIT, seen, &timeout, nullptr, 0);
        return value() != seen;
    }
};

struct WriterCounters {
    int64_t next_frame = 0;
    int64_t entries = 0;
    int64_t slots = 0;
    int64_t committed = 0;
    std::array<int64_t, 4> lost{};  // frames, by cause
    int64_t end = 0;                // 0 while the capture runs, then the number of the reason
};

struct ReaderCounters {
    int64_t next_frame = 0;  // received + lost
    int64_t received = 0;
    int64_t lost = 0;
    int64_t next_entry = 0;  // position in the log
    int64_t next_slot = 0;
    int64_t overruns = 0;
    int64_t lagging = 0;
};

struct DeviceStatus {
    int64_t state = 0;
    std::array<char, 192> reason{};  // UTF-8, padded with zeros
};

struct ReaderLabel {
    int64_t policy = 0;
    int64_t lease_slots = 0;
    std::array<char, 48> name{};  // UTF-8, padded with zeros
};

// Progress of one reader. `owner` is claimed by compare-and-swap from free or from a dead process. The label is valid
// once `described_by` equals the owner.
struct ReaderPlace {
    alignas(64) std::atomic<uint64_t> owner;
    std::atomic<uint64_t> described_by;
    DoubleBuffer<ReaderLabel> label;
    DoubleBuffer<ReaderCounters> counters;
};

constexpr size_t reader_places = 16;

// All zero is the state before the first frame, so a new file needs no initialisation.
struct Shared {
    alignas(64) DoubleBuffer<WriterCounters> writer;
    DoubleBuffer<DeviceStatus> device_status;
    alignas(64) std::atomic<uint64_t> reserved;
    alignas(64) Bell committed;
    alignas(64) Bell progress;
    ReaderPlace readers[reader_places];
    alignas(64) LogPlace log[1];  // as many as the file has room for
};

}  // namespace spiked
