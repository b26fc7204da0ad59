"""A camera trajectory as poses at times, and the files that other tools read: TUM, KITTI, COLMAP, nerfstudio."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.pose import Array, quaternion, rotation_of
from spiked.sensor import Sensor


@dataclass(frozen=True)
class Trajectory:
    """`times_s` [n] increasing seconds, `rotations` [n, 3, 3] camera-to-world, `centres` [n, 3] in any length unit."""

    times_s: Array
    rotations: Array
    centres: Array

    def __len__(self) -> int:
        return len(self.times_s)

    def matrices(self) -> Array:
        """Camera-to-world matrices [n, 4, 4]."""
        m = np.tile(np.eye(4), (len(self), 1, 1))
        m[:, :3, :3] = self.rotations
        m[:, :3, 3] = self.centres
        return m

    def between(self, begin_s: float, end_s: float) -> "Trajectory":
        """The poses with begin_s <= time < end_s."""
        keep = (self.times_s >= begin_s) & (self.times_s < end_s)
        return Trajectory(self.times_s[keep], self.rotations[keep], self.centres[keep])

    @classmethod
    def read_tum(cls, path: Path | str) -> "Trajectory":
        """Read `timestamp_s tx ty tz qx qy qz qw` lines; poses are sorted by time."""
        try:
            lines = Path(path).read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise SceneError(f"cannot read trajectory {path}: {error}") from error
        rows = []
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            try:
                row = [float(word) for word in words]
            except ValueError:
                row = []
            if len(row) != 8 or not np.all(np.isfinite(row)) or np.linalg.norm(row[4:]) < 1e-6:
                raise SceneError(
                    f"{path}, line {number}: expected 'timestamp_s tx ty tz qx qy qz qw', got {line[:80]!r}"
                )
            rows.append(row)
        if not rows:
            raise SceneError(f"{path} holds no poses; expected lines 'timestamp_s tx ty tz qx qy qz qw'")
        table = np.array(sorted(rows))
        return cls(table[:, 0], rotation_of(table[:, [7, 4, 5, 6]]), table[:, 1:4])

    def tum(self) -> str:
        """The text of a TUM file (quaternions xyzw)."""
        q = quaternion(self.rotations)[:, [1, 2, 3, 0]]
        head = "# timestamp_s tx ty tz qx qy qz qw (camera to world, OpenCV axes, middle of each frame)\n"
        rows = np.column_stack([self.centres, q])
        return head + "".join(
            f"{t:.9f} " + " ".join(f"{x:.9f}" for x in row) + "\n" for t, row in zip(self.times_s, rows, strict=True)
        )

    def kitti(self) -> str:
        """The text of a KITTI file: the upper three rows of each camera-to-world matrix; times are not kept."""
        rows = self.matrices()[:, :3].reshape(-1, 12)
        return "".join(" ".join(f"{x:.9e}" for x in row) + "\n" for row in rows)

    def colmap(self) -> str:
        """The text of COLMAP's `images.txt`: world-to-camera quaternion wxyz and translation, camera 1."""
        inverse = self.rotations.swapaxes(-1, -2)
        q = quaternion(inverse)
        t = -np.einsum("nij,nj->ni", inverse, self.centres)
        head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each followed by an empty line of points\n"
        lines = (
            f"{i + 1} " + " ".join(f"{x:.9f}" for x in (*q[i], *t[i])) + f" 1 {self.times_s[i]:.9f}.png\n\n"
            for i in range(len(self))
        )
        return head + "".join(lines)

    def colmap_model(self, sensor: Sensor) -> dict[str, bytes | str]:
        """The files of a COLMAP text model without points, by name. Raises SceneError without intrinsics."""
        if sensor.intrinsics is None:
            raise SceneError("a COLMAP model needs intrinsics; give --intrinsics or --fov")
        k = sensor.intrinsics
        camera = f"1 PINHOLE {sensor.width} {sensor.height} {k.fx!r} {k.fy!r} {k.cx!r} {k.cy!r}\n"
        return {
            "cameras.txt": "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n" + camera,
            "images.txt": self.colmap(),
            "points3D.txt": "# no points: the poses are from splats\n",
        }

    def nerfstudio(self, sensor: Sensor) -> str:
        """The text of nerfstudio's `transforms.json`: camera-to-world with OpenGL axes (y up, z back)."""
        if sensor.intrinsics is None:
            raise SceneError("nerfstudio's transforms.json needs intrinsics; give --intrinsics or --fov")
        k = sensor.intrinsics
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        frames = [
            {"file_path": f"images/{t:.9f}.png", "transform_matrix": (m @ flip).tolist()}
            for t, m in zip(self.times_s, self.matrices(), strict=True)
        ]
        camera = {"camera_model": "OPENCV", "w": sensor.width, "h": sensor.height}
        return json.dumps({**camera, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "frames": frames}, indent=1)

    def write_tum(self, path: Path | str) -> None:
        """Write a TUM file."""
        Path(path).write_text(self.tum(), encoding="utf-8")

    def nearest(self, times_s: Array, within_s: float) -> NDArray[np.int64]:
        """For each time the index of the nearest pose, or -1 where none lies within `within_s`."""
        if len(self) == 0:
            return np.full(len(times_s), -1, np.int64)
        j = np.clip(np.searchsorted(self.times_s, times_s), 1, max(len(self) - 1, 1))
        before = np.abs(self.times_s[j - 1] - times_s) < np.abs(self.times_s[np.minimum(j, len(self) - 1)] - times_s)
        j = np.minimum(np.where(before, j - 1, j), len(self) - 1)
        return np.where(np.abs(self.times_s[j] - times_s) <= within_s, j, -1).astype(np.int64)
