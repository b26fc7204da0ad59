"""The cameras and sources that this machine has."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Device:
    """Something that a capture can be started from."""

    source: str
    """What to give as `source`: sim: or replay:FILE, with options after a question mark."""
    kind: str
    description: str


def known_devices(configured: list[str]) -> list[Device]:
    """The sources named to the daemon, and the one that is always there."""
    named = [Device(source, source.partition(":")[0], "given with --device") for source in configured]
    built_in = [
        Device("sim:", "sim", "simulated hand-held camera in a built-in room; options seed, seconds, width, height"),
        Device("replay:FILE", "replay", "a recording; options pace, repeat, range"),
    ]
    return named + [device for device in built_in if device.source not in configured]
