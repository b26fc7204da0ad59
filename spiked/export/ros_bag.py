"""A ROS 2 bag: path, pictures, depth maps and points as standard messages, written without ROS."""

import errno
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from spiked.export.kind import ExportKind, optional
from spiked.export.ros_messages import RosMessages
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.timeline import CAMERA, MAP, MAP_TO_WORLD_XYZW, WORLD, Timeline, read_timeline

__all__ = ["FILES", "KIND", "RosBag"]

VERSION = 8
"""Of bags: Humble to Jazzy read it; SQLite storage is in all of them."""
LATCHED = ("/tf_static", "/points")
"""Topics whose message is kept for those that subscribe later."""
FILES = ("*.db3", "metadata.yaml")
"""Patterns of the files of a bag."""
ORIGIN = (0.0, 0.0, 0.0)
"""No translation, in any unit."""


def fill(source: ExportSource, folder: Path, options: ExportOptions) -> str:
    """Write the bag's folder. Raises SceneError and ConfigurationError."""
    timeline = read_timeline(source, options)
    make = RosMessages()
    with RosBag(folder, make, source.scale.texts) as bag:
        for topic, at, message in _messages(make, timeline):
            bag.write(topic, at, message)
    return timeline.said()


def _messages(make: RosMessages, timeline: Timeline) -> Iterator[tuple[str, int, Any]]:
    """Topic, time in ns and message."""
    begin = int(timeline.stamps_ns[0])
    yield "/tf_static", begin, make.transform(begin, MAP, WORLD, ORIGIN, MAP_TO_WORLD_XYZW)
    yield "/points", begin, make.cloud(begin, WORLD, timeline.point_table())
    for stamp, *pose in zip(timeline.stamps_ns, timeline.centres, timeline.quats_xyzw, strict=True):
        at = int(stamp)
        yield "/tf", at, make.transform(at, WORLD, CAMERA, *pose)
        yield "/pose", at, make.pose(at, WORLD, *pose)
    for key in timeline.keys:
        at = key.stamp_ns
        yield "/camera/camera_info", at, make.camera_info(at, CAMERA, key.view.camera)
        yield "/camera/image_raw", at, make.image(at, CAMERA, key.pixels)
        depth = np.where(key.view.depth > 0, key.view.depth, np.float32(np.nan))  # REP 118: no surface is NaN
        yield "/camera/depth", at, make.image(at, CAMERA, depth)


class RosBag:
    """Writes a bag into an empty folder, which names its files. After an error the folder is not a bag."""

    def __init__(self, folder: Path, make: RosMessages, about: Mapping[str, str] | None = None) -> None:
        """`about` becomes `custom_data` of metadata.yaml. Raises ConfigurationError if rosbags is not installed."""
        self._about = about or {}
        self._rosbag2 = optional("rosbags.rosbag2", "ros")
        self._folder, self._store = folder, make.store
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "RosBag":
        self._folder.rmdir()  # the writer makes it
        self._writer = self._rosbag2.Writer(self._folder, version=VERSION)
        with _sqlite_errors():
            self._writer.open()
        for name, text in self._about.items():
            self._writer.set_custom_data(name, text)
        return self

    def write(self, topic: str, at_ns: int, message: Any) -> None:
        """Append a message; the first of a topic decides its type. Raises OSError."""
        kind = message.__msgtype__
        with _sqlite_errors():
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=self._store, offered_qos_profiles=_latched() if topic in LATCHED else ()
                )
            self._writer.write(self._connections[topic], at_ns, self._store.serialize_cdr(message, kind))

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Finish the bag. Raises OSError."""
        if kind is None:
            with _sqlite_errors():
                self._writer.close()
        else:
            with suppress(sqlite3.Error):  # the first error is told
                self._writer.storage.abort()


@contextmanager
def _sqlite_errors() -> Iterator[None]:
    """Turn SQLite's errors of the disk into OSError."""
    try:
        yield
    except sqlite3.OperationalError as error:
        number = errno.ENOSPC if error.sqlite_errorcode == sqlite3.SQLITE_FULL else errno.EIO
        raise OSError(number, os.strerror(number)) from error


def _latched() -> list[Any]:
    """Reliable, transient local, the last message: what subscribers of /tf_static ask for."""
    i = optional("rosbags.interfaces", "ros")
    none = i.QosTime(0, 0)
    return [
        i.Qos(
            i.QosHistory.KEEP_LAST,
            1,
            i.QosReliability.RELIABLE,
            i.QosDurability.TRANSIENT_LOCAL,
            none,
            none,
            i.QosLiveliness.AUTOMATIC,
            none,
            False,
        )
    ]


KIND = ExportKind(
    name="ros-bag",
    title="ROS 2 bag: path, pictures, depth maps, points",
    readers="ROS 2 from Humble on (RViz, ros2 bag play), Foxglove, rosbags, PlotJuggler",
    loses="splats; transparency",
    suffix="",
    fill=fill,
    packages=("rosbags.rosbag2",),
    replaces=FILES,
    extra="ros",
)
