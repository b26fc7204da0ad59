"""Messages of ROS 2 made of arrays, by the package `rosbags`: no ROS is needed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.export.kind import optional
from spiked.export.timeline import camera_message
from spiked.render import Camera

__all__ = ["RosMessages"]

FISHEYE = "equidistant"
"""ROS's name of Kannala and Brandt's model."""


class RosMessages:
    """Makes messages; `store` serialises them. Times are in ns."""

    def __init__(self) -> None:
        """Raises ConfigurationError if rosbags is not installed."""
        typesys = optional("rosbags.typesys", "ros")
        self.store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)

    def header(self, at_ns: int, frame: str) -> Any:
        """std_msgs/Header."""
        stamp = self._new("builtin_interfaces/msg/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def transform(self, at_ns: int, parent: str, child: str, centre: Any, quat_xyzw: Any) -> Any:
        """tf2_msgs/TFMessage of one transform, child to parent."""
        moved = self._new(
            "geometry_msgs/msg/Transform", translation=self._xyz("Vector3", centre), rotation=self._quat(quat_xyzw)
        )
        stamped = self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(at_ns, parent),
            child_frame_id=child,
            transform=moved,
        )
        return self._new("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def pose(self, at_ns: int, frame: str, centre: Any, quat_xyzw: Any) -> Any:
        """geometry_msgs/PoseStamped."""
        pose = self._new(
            "geometry_msgs/msg/Pose", position=self._xyz("Point", centre), orientation=self._quat(quat_xyzw)
        )
        return self._new("geometry_msgs/msg/PoseStamped", header=self.header(at_ns, frame), pose=pose)

    def image(self, at_ns: int, frame: str, pixels: NDArray[Any]) -> Any:
        """sensor_msgs/Image: uint8 [H, W] as mono8, uint8 [H, W, 3] as rgb8, float32 [H, W] as 32FC1."""
        kinds = {("u1", 2): "mono8", ("u1", 3): "rgb8", ("f4", 2): "32FC1"}
        raw = np.ascontiguousarray(pixels)
        return self._new(
            "sensor_msgs/msg/Image",
            header=self.header(at_ns, frame),
            height=raw.shape[0],
            width=raw.shape[1],
            encoding=kinds[raw.dtype.str[1:], raw.ndim],
            is_bigendian=0,
            step=raw.strides[0],
            data=raw.view(np.uint8).reshape(-1),
        )

    def camera_info(self, at_ns: int, frame: str, camera: Camera) -> Any:
        """sensor_msgs/CameraInfo."""
        optics = camera_message(camera, FISHEYE)
        region = self._new(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._new(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(at_ns, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=optics.model,
            d=np.array(optics.d),
            k=np.array(optics.k),
            r=np.eye(3).reshape(-1),
            p=np.array(optics.p),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def cloud(self, at_ns: int, frame: str, points: NDArray[np.void]) -> Any:
        """sensor_msgs/PointCloud2 of points [n] of type `POINT`; colours are packed into `rgb` as PCL and RViz read."""
        packed = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
        table = np.zeros(len(points), packed)
        for axis in "xyz":
            table[axis] = points[axis]
        red, green, blue = (points[name].astype(np.uint32) for name in ("red", "green", "blue"))
        table["rgb"] = red << 16 | green << 8 | blue
        # rgb is read as the bits of a float
        fields = [
            self._new("sensor_msgs/msg/PointField", name=name, offset=4 * number, datatype=7, count=1)
            for number, name in enumerate(packed.names or ())
        ]
        return self._new(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(at_ns, frame),
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=packed.itemsize,
            row_step=table.nbytes,
            data=table.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def _xyz(self, kind: str, values: Any) -> Any:
        x, y, z = map(float, values)
        return self._new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quat(self, xyzw: Any) -> Any:
        x, y, z, w = map(float, xyzw)
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _new(self, kind: str, /, **fields: Any) -> Any:
        return self.store.types[kind](**fields)
