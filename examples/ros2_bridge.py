"""Poses and pictures of the service as messages of ROS 2, live or into a bag.

python ros2_bridge.py [ws://127.0.0.1:8650] [--bag FOLDER] [--captures N]

Without --bag it publishes by rclpy, for which ROS 2 must be sourced; with it a bag is written, and ROS is not needed.
Needs `pip install 'spiked[ros]'`. Topics: /tf (world to camera_optical), /pose, /camera/image_raw. It ends after the
reconstructions of N captures, or when the service does.
"""

import argparse
import base64
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from spiked.export.ros_bag import FILES, RosBag
from spiked.export.ros_messages import RosMessages
from spiked.export.timeline import CAMERA, WORLD
from spiked.whole_files import whole_folder

Send = Callable[[str, int, Any], None]
"""Takes topic, time in ns and message."""


def picture(data: dict[str, Any]) -> np.ndarray:
    """The preview of an event, [H, W] or RGB [H, W, 3]."""
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data["image"]), np.uint8), cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])


def forward(address: str, make: RosMessages, send: Send, captures: int) -> None:
    """Send what happens in the service until that many reconstructions have ended."""
    with (
        suppress(ConnectionClosed, KeyboardInterrupt),
        connect(f"{address}/api/v1/events?topics=pose,preview,job", max_size=None) as events,
    ):
        print("connected", flush=True)
        ended: set[str] = set()
        for message in map(json.loads, events):
            data = message["data"]
            at = round(datetime.fromisoformat(message["at"]).timestamp() * 1e9)
            if message["topic"] == "pose":
                taken = at - round(1e9 * (data["latency_s"] or 0))
                w, *xyz = data["quaternion_wxyz"]
                pose = (data["position"], (*xyz, w))
                send("/tf", at, make.transform(taken, WORLD, CAMERA, *pose))
                send("/pose", at, make.pose(taken, WORLD, *pose))
            elif message["topic"] == "preview" and data["kind"] == "interval":
                send("/camera/image_raw", at, make.image(at, CAMERA, picture(data)))
            elif message["topic"] == "job" and data["state"] in ("complete", "cancelled", "failed"):
                ended.add(data["id"])  # a job that has ended may be told of again, as when it is renamed
                if len(ended) == captures:
                    return


@contextmanager
def publishing(make: RosMessages) -> Iterator[Send]:
    """Publishes serialised messages by rclpy."""
    import rclpy
    from rosidl_runtime_py.utilities import get_message

    rclpy.init()
    node, publishers = rclpy.create_node("spiked"), {}

    def send(topic: str, at_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in publishers:
            publishers[topic] = node.create_publisher(get_message(kind), topic, 10)
        publishers[topic].publish(bytes(make.store.serialize_cdr(message, kind)))

    try:
        yield send
    finally:
        node.destroy_node()
        rclpy.shutdown()


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", nargs="?", default="ws://127.0.0.1:8650")
    parser.add_argument("--bag", type=Path, help="folder of a bag to write, in place of publishing")
    parser.add_argument("--captures", type=int, default=0, help="end after so many reconstructions; 0: never")
    asked = parser.parse_args()
    make = RosMessages()
    if asked.bag is None:
        with publishing(make) as send:
            forward(asked.address, make, send, asked.captures)
    else:
        with whole_folder(asked.bag, FILES) as folder, RosBag(folder, make) as bag:
            forward(asked.address, make, bag.write, asked.captures)


if __name__ == "__main__":
    main()
