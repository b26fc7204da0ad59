// Python bindings of the wire parsers; spiked_driver.framing and spiked_driver.pcie document and wrap them.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "pcie.hpp"
#include "usb.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace spiked {
namespace {

using Bytes = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Frames = nb::ndarray<uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// A parser and the chunk that it reads in place.
template <class Parser>
struct Holder {
    Parser parser;
    Bytes chunk;

    void feed(Bytes bytes) {
        parser.feed(bytes.data(), bytes.size());
        chunk = bytes;
    }
    void keep() {
        parser.keep();
        chunk = Bytes();
    }
    Event next(Frames out) {
        if (out.shape(1) != Parser::compact_bytes) throw std::invalid_argument("the view is not of compact frames");
        nb::gil_scoped_release release;
        return parser.next(out.data(), out.shape(0));
    }
};

template <class Parser>
nb::class_<Holder<Parser>> bind(nb::module_& m, const char* name) {
    using Held = Holder<Parser>;
    return nb::class_<Held>(m, name)
        .def(nb::init<>())
        .def("feed", &Held::feed, "chunk"_a)
        .def("keep", &Held::keep)
        .def("finish", [](Held& held) { held.parser.finish(); })
        .def("mark_loss", [](Held& held) { held.parser.mark_loss(); })
        .def("next", &Held::next, "out"_a.noconvert())
        .def_prop_ro("next_index", [](const Held& held) { return held.parser.next_index(); })
        .def_prop_ro("counters", [](const Held& held) { return held.parser.counters(); });
}

}  // namespace

NB_MODULE(_wire, m) {
    nb::enum_<Kind>(m, "Kind")
        .value("NONE", Kind::none)
        .value("FRAMES", Kind::frames)
        .value("DEVICE_GAP", Kind::device_gap)
        .value("HOST_GAP", Kind::host_gap);
    nb::class_<Event>(m, "Event")
        .def_ro("kind", &Event::kind)
        .def_ro("first", &Event::first)
        .def_ro("count", &Event::count);
    nb::class_<Counters>(m, "Counters")
        .def_ro("bytes", &Counters::bytes)
        .def_ro("received", &Counters::received)
        .def_ro("lost", &Counters::lost)
        .def_ro("duplicates", &Counters::duplicates)
        .def_ro("skipped", &Counters::skipped)
        .def_ro("resyncs", &Counters::resyncs)
        .def_ro("restarts", &Counters::restarts);
    bind<UsbParser>(m, "UsbParser")
        .def("resume", [](Holder<UsbParser>& held, int64_t lost, int64_t tolerance, Kind kind) {
            held.parser.resume(lost, tolerance, kind);
        });
    bind<PcieParser>(m, "PcieParser");
}

}  // namespace spiked
