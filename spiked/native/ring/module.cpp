// Python bindings of the shared part of a ring; spiked/ring documents and wraps them.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <stdexcept>
#include <string>

#include "shared.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace spiked {
namespace {

using Memory = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <size_t N>
std::array<char, N> to_chars(const std::string& text) {
    std::array<char, N> chars{};
    std::copy_n(text.begin(), std::min(text.size(), N), chars.begin());
    return chars;
}

template <size_t N>
nb::bytes to_bytes(const std::array<char, N>& chars) {
    return nb::bytes(chars.data(), static_cast<size_t>(std::find(chars.begin(), chars.end(), '\0') - chars.begin()));
}

class Control {
    Memory memory_;  // keeps the mapping alive
    Shared* shared_;
    uint64_t log_places_;

  public:
    static size_t bytes(size_t log_places) { return sizeof(Shared) + log_places * sizeof(LogPlace); }

    // Of memory that is mapped read-only, only what reads may be called: `writer`, `read_entry`, `reserved`, waits.
    Control(Memory memory, size_t log_places)
        : memory_(memory),
          shared_(reinterpret_cast<Shared*>(const_cast<uint8_t*>(memory.data()))),
          log_places_(log_places) {
        if (memory.size() < bytes(log_places)) throw std::invalid_argument("the memory is too small for the log");
        if (reinterpret_cast<uintptr_t>(memory.data()) % alignof(Shared))
            throw std::invalid_argument("the memory is not aligned to 64 bytes");
    }

    Shared& shared() const { return *shared_; }
    ReaderPlace& place(size_t index) const {
        if (index >= reader_places) throw std::out_of_range("no such reader place");
        return shared_->readers[index];
    }

    void write_entry(uint64_t position, const Entry& entry) {
        shared_->log[position % log_places_].write(position, entry);
    }
    std::optional<Entry> read_entry(uint64_t position) const {
        return shared_->log[position % log_places_].read(position);
    }

    // Announces that slots below `total` - slots in the ring are about to change. Call it before changing them.
    void reserve(uint64_t total) {
        shared_->reserved.store(total, std::memory_order_relaxed);
        std::atomic_thread_fence(std::memory_order_release);
    }

    // Number of slots reserved so far. Call it after reading a slot, to check that it was not overwritten meanwhile.
    uint64_t reserved() const {
        std::atomic_thread_fence(std::memory_order_acquire);
        return shared_->reserved.load(std::memory_order_relaxed);
    }
};

}  // namespace

NB_MODULE(_ring, m) {
    m.attr("READER_PLACES") = reader_places;

    nb::class_<Entry>(m, "Entry")
        .def(
            "__init__",
            [](Entry* self, int64_t first, int64_t count, int64_t cause, int64_t slot) {
                new (self) Entry{first, count, cause, slot};
            },
            "first"_a, "count"_a, "cause"_a, "slot"_a)
        .def_ro("first", &Entry::first)
        .def_ro("count", &Entry::count)
        .def_ro("cause", &Entry::cause)
        .def_ro("slot", &Entry::slot);

    nb::class_<WriterCounters>(m, "WriterCounters")
        .def(nb::init<>())
        .def_rw("next_frame", &WriterCounters::next_frame)
        .def_rw("entries", &WriterCounters::entries)
        .def_rw("slots", &WriterCounters::slots)
        .def_rw("committed", &WriterCounters::committed)
        .def_ro("lost", &WriterCounters::lost)
        .def("add_lost", [](WriterCounters& self, size_t cause, int64_t count) { self.lost.at(cause) += count; })
        .def_rw("end", &WriterCounters::end);

    nb::class_<ReaderCounters>(m, "ReaderCounters")
        .def(nb::init<>())
        .def_rw("next_frame", &ReaderCounters::next_frame)
        .def_rw("received", &ReaderCounters::received)
        .def_rw("lost", &ReaderCounters::lost)
        .def_rw("next_entry", &ReaderCounters::next_entry)
        .def_rw("next_slot", &ReaderCounters::next_slot)
        .def_rw("overruns", &ReaderCounters::overruns)
        .def_rw("lagging", &ReaderCounters::lagging);

    nb::class_<Bell>(m, "Bell")
        .def("value", &Bell::value)
        .def("ring", &Bell::ring)
        .def("wait", &Bell::wait, "seen"_a, "timeout_s"_a, nb::call_guard<nb::gil_scoped_release>());

    nb::class_<ReaderPlace>(m, "ReaderPlace")
        .def("owner", [](const ReaderPlace& self) { return self.owner.load(std::memory_order_acquire); })
        .def("described_by", [](const ReaderPlace& self) { return self.described_by.load(std::memory_order_acquire); })
        .def("claim",
             [](ReaderPlace& self, uint64_t from, uint64_t to) { return self.owner.compare_exchange_strong(from, to); })
        .def("describe",
             [](ReaderPlace& self, int64_t policy, int64_t lease_slots, const std::string& name) {
                 self.label.publish({policy, lease_slots, to_chars<sizeof(ReaderLabel::name)>(name)});
                 self.described_by.store(self.owner.load(std::memory_order_relaxed), std::memory_order_release);
             })
        .def("label",
             [](const ReaderPlace& self) {
                 const ReaderLabel label = self.label.read();
                 return nb::make_tuple(label.policy, label.lease_slots, to_bytes(label.name));
             })
        .def("publish", [](ReaderPlace& self, const ReaderCounters& counters) { self.counters.publish(counters); })
        .def("counters", [](const ReaderPlace& self) { return self.counters.read(); });

    nb::class_<Control>(m, "Control")
        .def(nb::init<Memory, size_t>(), "memory"_a, "log_places"_a)
        .def_static("bytes", &Control::bytes, "log_places"_a)
        .def("publish", [](Control& self, const WriterCounters& counters) { self.shared().writer.publish(counters); })
        .def("writer", [](const Control& self) { return self.shared().writer.read(); })
        .def("publish_condition",
             [](Control& self, int64_t state, const std::string& reason) {
                 self.shared().device_status.publish({state, to_chars<sizeof(DeviceStatus::reason)>(reason)});
             })
        .def("condition",
             [](const Control& self) {
                 const DeviceStatus status = self.shared().device_status.read();
                 return nb::make_tuple(status.state, to_bytes(status.reason));
             })
        .def("reserve", &Control::reserve, "total"_a)
        .def("reserved", &Control::reserved)
        .def("write_entry", &Control::write_entry, "position"_a, "entry"_a)
        .def("read_entry", &Control::read_entry, "position"_a)
        .def_prop_ro(
            "committed", [](const Control& self) -> Bell& { return self.shared().committed; },
            nb::rv_policy::reference_internal)
        .def_prop_ro(
            "progress", [](const Control& self) -> Bell& { return self.shared().progress; },
            nb::rv_policy::reference_internal)
        .def("place", &Control::place, "index"_a, nb::rv_policy::reference_internal);
}

}  // namespace spiked
