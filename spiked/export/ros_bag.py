"""A ROS 2 bag: path, pictures, depth maps and points as standard messages, written without ROS."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from spiked.errors import SceneError
from spiked.export.kind import ExportKind, optional
from spiked.export.ros_messages import RosMessages
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.timeline import CAMERA, MAP, MAP_TO_WORLD_XYZW, WORLD, Timeline, read_timeline

__all__ = ["KIND", "RosBag"]

VERSION = 8
"""Of bags: Humble to Jazzy read it; SQLite storage is in all of them."""
LATCHED = ("/tf_static", "/points")
"""Topics whose message is kept for those that subscribe later."""
ORIGIN = (0.0, 0.0, 0.0)
"""No translation, in any unit."""


def write(source: ExportSource, folder: Path, options: ExportOptions) -> str:
    """Write the bag's folder. Raises SceneError and ConfigurationError."""
    timeline = read_timeline(source, options)
    make = RosMessages()
    with RosBag(folder, make) as bag:
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
        yield "/camera/depth", at, make.image(at, CAMERA, key.view.depth)


class RosBag:
    """Writes a bag into a folder; an earlier one in it is replaced when the new one is complete."""

    def __init__(self, folder: Path, make: RosMessages) -> None:
        """Raises SceneError if the folder holds files of something else."""
        strange = [file.name for file in folder.glob("*") if file.name != "metadata.yaml" and file.suffix != ".db3"]
        if strange:
            raise SceneError(f"{folder} holds {strange[0]}, and a bag has a folder of its own; choose another one")
        self._rosbag2 = optional("rosbags.rosbag2", "ros")
        self._folder, self._store = folder, make.store
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "RosBag":
        self._folder.mkdir(parents=True, exist_ok=True)
        self._made = TemporaryDirectory(dir=self._folder)
        self._place = Path(self._made.name) / self._folder.resolve().name
        self._writer = self._rosbag2.Writer(self._place, version=VERSION)
        self._writer.open()
        return self

    def write(self, topic: str, at_ns: int, message: Any) -> None:
        """Append a message; the first of a topic decides its type."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=_latched() if topic in LATCHED else ()
            )
        self._writer.write(self._connections[topic], at_ns, self._store.serialize_cdr(message, kind))

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._writer.close()
        if kind is None:
            for old in [*self._folder.glob("*.db3"), *self._folder.glob("metadata.yaml")]:
                old.unlink()
            for file in self._place.iterdir():
                file.replace(self._folder / file.name)
        self._made.cleanup()


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
    write=write,
    packages=("rosbags.rosbag2",),
    extra="ros",
)
