"""Addresses of sources: the device that one names, and its pace."""

from urllib.parse import urlencode

from spiked_driver.source_kinds import find_kind


def device_of(source: str) -> str:
    """The device of a source: a camera without its options; a file or simulation with all but its pace."""
    address, _, query = source.partition("?")
    kind = find_kind(source)
    if kind is None or not kind.can_block:
        return address
    options = [option for option in query.split("&") if option and not option.startswith("pace=")]
    return f"{address}?{'&'.join(options)}" if options else address


def unpaced(source: str) -> str:
    """The source with `pace=0` unless it has a pace: files and simulations then wait for their readers.

    Cameras are unchanged. `pace=1` replays at the recorded rate and loses frames that are not read in time.
    """
    address, _, query = source.partition("?")
    kind = find_kind(source)
    if kind is None or not kind.can_block or "pace=" in query:
        return source
    return f"{address}?{query}&{urlencode({'pace': 0})}" if query else f"{address}?pace=0"


def realtime(source: str) -> str:
    """The source without `pace=0`: in real time, because an armed device has no reader to wait for."""
    address, _, query = source.partition("?")
    options = [option for option in query.split("&") if option and option != "pace=0"]
    return f"{address}?{'&'.join(options)}" if options else address
