"""Writes folders in the layouts of the data sets, of frames that are known."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import quaternion
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

SIDE = 512
"""Of the SPAD512S and of a whole SwissSPAD2."""
PICTURE_FRAMES = 32
"""A picture with a pose for so many frames."""


@dataclass(frozen=True)
class Source:
    """Frames, upright, with the camera that saw them."""

    pixels: NDArray[np.uint8]
    """[n, height, width] of 0 and 1."""
    intrinsics: Intrinsics
    path: Trajectory
    """A pose at the middle of each frame."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[2], self.pixels.shape[1]

    def padded(self, height: int, width: int = SIDE) -> "Source":
        """The same frames in the upper left corner of a larger, dark sensor."""
        pixels = np.zeros((len(self.pixels), height, width), np.uint8)
        pixels[:, : self.size[1], : self.size[0]] = self.pixels
        return Source(pixels, self.intrinsics, self.path)

    def dat(self, first: int = 0, stop: int | None = None) -> bytes:
        """The bytes of a `.dat`: LSB first, rows bottom-up."""
        return np.packbits(self.pixels[first:stop, ::-1], axis=2, bitorder="little").tobytes()

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """Mean of the frames around one, [height, width]."""
        near = self.pixels[max(0, frame - 16) : frame + 17]
        return np.round(255 * near.mean(0)).astype(np.uint8)

    def poses(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Camera to world, OpenCV axes, [n, 4, 4]."""
        return self.path.matrices()[frames]


def numbered(source: Source) -> NDArray[np.int64]:
    """Frames that have a picture with a pose."""
    return np.arange(PICTURE_FRAMES // 2, len(source.pixels), PICTURE_FRAMES)


def save_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def write_transforms(path: Path, names: list[str], poses: NDArray[np.float64], source: Source, **more: object) -> None:
    """A `transforms.json` of nerfstudio: OpenGL's camera axes."""
    k, (width, height) = source.intrinsics, source.size
    camera = {"camera_model": "OPENCV", "w": width, "h": height, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy}
    flipped = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"file_path": n, "transform_matrix": m.tolist()} for n, m in zip(names, flipped, strict=True)]
    path.write_text(json.dumps({**camera, **more, "frames": frames}))


def write_colmap(
    folder: Path, names: list[str], poses: NDArray[np.float64], source: Source, text: bool = False
) -> None:
    """A COLMAP model with one PINHOLE camera, observations, and points one unit in front of each camera."""
    folder.mkdir(parents=True, exist_ok=True)
    k, (width, height) = source.intrinsics, source.size
    inverse = np.linalg.inv(poses)
    q, t = quaternion(inverse[:, :3, :3]), inverse[:, :3, 3]
    points = poses[:, :3, 3] + poses[:, :3, 2]
    if text:
        (folder / "cameras.txt").write_text(f"# cameras\n1 PINHOLE {width} {height} {k.fx!r} {k.fy!r} {k.cx} {k.cy}\n")
        rows = [
            f"{i} {' '.join(map(repr, [*a.tolist(), *b.tolist()]))} 1 {name}\n10.5 20.5 1 3 4 -1\n"
            for i, (a, b, name) in enumerate(zip(q, t, names, strict=True), 1)
        ]
        (folder / "images.txt").write_text("# images\n" + "".join(rows))
        lines = [f"{i} {' '.join(map(repr, p.tolist()))} 9 9 9 0.5 1 0\n" for i, p in enumerate(points, 1)]
        (folder / "points3D.txt").write_text("".join(lines))
        return
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, width, height, k.fx, k.fy, k.cx, k.cy)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(names))
    for i, (a, b, name) in enumerate(zip(q, t, names, strict=True), 1):
        images += struct.pack("<I7dI", i, *a, *b, 1) + name.encode() + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<ddqddq", 10.5, 20.5, 1, 3.0, 4.0, -1)
    (folder / "images.bin").write_bytes(images)
    cloud = struct.pack("<Q", len(points))
    for i, p in enumerate(points, 1):
        cloud += struct.pack("<Q3d3BdQii", i, *p, 9, 9, 9, 0.5, 1, 1, 0)
    (folder / "points3D.bin").write_bytes(cloud)


def usp_gaussian(folder: Path, source: Source, frames: int = 100, step: int = 60) -> None:
    """Clips that overlap, as cut from one recording; the last ends with it."""
    scene = folder / "real_world" / "sheep"
    (scene / "spike_data").mkdir(parents=True)
    starts = [*range(0, len(source.pixels) - frames, step), len(source.pixels) - frames]
    for number, start in enumerate(starts):
        (scene / "spike_data" / f"{number:06d}.dat").write_bytes(source.dat(start, start + frames))
        save_picture(scene / "sharp_data" / f"{number:06d}.png", source.picture(start + frames // 2))
    names = [f"sharp_data/{number:06d}.png" for number in range(len(starts))]
    write_transforms(scene / "transforms.json", names, source.poses(np.array(starts) + frames // 2), source)


def spikegs_real(folder: Path, source: Source) -> None:
    frames = numbered(source)
    for frame in frames:
        for kind in ("images", "tfp"):
            save_picture(folder / "shop" / kind / f"{frame:05d}.png", source.picture(frame))
    names = [f"{frame:05d}.png" for frame in frames]
    write_colmap(folder / "shop" / "sparse" / "0", names, source.poses(frames), source)
    (folder / "shop" / "spikes.dat").write_bytes(source.dat())


def spikegs_synthetic(folder: Path, source: Source) -> None:
    frames = numbered(source)
    scene = folder / "toys"
    angle = 2 * float(np.arctan(0.5 * source.size[0] / source.intrinsics.fx))
    for split, chosen in (("train", frames[::2]), ("test", frames[1::2]), ("TFP", frames)):
        for frame in chosen:
            save_picture(scene / split / f"r_{frame}.png", source.picture(frame))
        flipped = source.poses(chosen) @ np.diag([1.0, -1.0, -1.0, 1.0])
        rows = [
            {"file_path": f"./{split}/r_{frame}", "transform_matrix": m.tolist()}
            for frame, m in zip(chosen, flipped, strict=True)
        ]
        (scene / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": rows}))
    (scene / "toys.dat").write_bytes(source.dat())


def spike_zoo(folder: Path, source: Source) -> None:
    (folder / "test" / "spike").mkdir(parents=True)
    (folder / "test" / "spike" / "0000.dat").write_bytes(source.dat())
    save_picture(folder / "test" / "gt" / "0000.png", source.picture(len(source.pixels) // 2))


def spike_zoo_arrays(folder: Path, source: Source) -> None:
    (folder / "train" / "0").mkdir(parents=True)
    np.savez_compressed(folder / "train" / "0" / "a_1.npz", spk=source.pixels.astype(bool))


def spikecv(folder: Path, source: Source) -> None:
    width, height = source.size
    (folder / "scene").mkdir()
    (folder / "config.yaml").write_text(
        f"filename: own\nspike_w: {width}\nspike_h: {height}\nis_labeled: false\nlabeled_data_type: [0]\n"
        "labeled_data_suffix: None\n"
    )
    (folder / "scene" / "spike.dat").write_bytes(source.dat())


def recvidarreal(folder: Path, source: Source) -> None:
    (folder / "classB").mkdir()
    (folder / "config.yaml").write_text(
        "filename: vidar_reconstruction2019\nspike_w: 400\nspike_h: 250\nis_labeled: false\nlabeled_data_type: [0]\n"
    )
    (folder / "classB" / "train-350kmh.dat").write_bytes(source.dat())


def outdoor_spike(folder: Path, source: Source) -> None:
    (folder / "seq_01.dat").write_bytes(source.dat())


def wision(folder: Path, source: Source) -> None:
    (folder / "binary" / "20kHz").mkdir(parents=True)
    np.save(folder / "binary" / "20kHz" / "cube.npy", np.packbits(source.pixels, axis=2))
    np.save(folder / "hot_pixel_mask.npy", np.zeros(source.pixels.shape[1:], bool))


def wision_bins(folder: Path, source: Source) -> None:
    place = folder / "full-array" / "20kHz"
    place.mkdir(parents=True)
    data = np.packbits(source.padded(SIDE).pixels, axis=2, bitorder="little").tobytes()
    for number, begin in enumerate(range(0, len(data), 3_000_001)):  # files need not end with a frame
        (place / f"{number}.bin").write_bytes(data[begin : begin + 3_000_001])


def spice_hl3(folder: Path, source: Source) -> None:
    place = folder / "data" / "intensity_images" / "acq00001"
    place.mkdir(parents=True)
    stored = np.packbits(np.rot90(source.padded(SIDE).pixels, -1, axes=(1, 2)), axis=2)
    for number, begin in enumerate(range(0, len(stored), 100)):
        (place / f"RAW{number:05d}.bin").write_bytes(stored[begin : begin + 100].tobytes() + b"DONE")


def spice_hl3_pictures(folder: Path, source: Source) -> None:
    for number, frame in enumerate(source.pixels, 1):
        first = 1 if number <= 96 else 97
        save_picture(folder / "1bit" / f"spad_1725960000.{first:09d}_frame{number - first + 1}.png", 255 * frame)


LAYOUTS: dict[str, tuple[str, Callable[[Path, Source], None], Callable[[Source], Source]]] = {
    "usp-gaussian": ("usp-gaussian", usp_gaussian, lambda source: source),
    "spikegs-real": ("spikegs-real", spikegs_real, lambda source: source),
    "spikegs-synthetic": ("spikegs-synthetic", spikegs_synthetic, lambda source: source),
    "spike-zoo": ("spike-zoo", spike_zoo, lambda source: source),
    "spike-zoo arrays": ("spike-zoo", spike_zoo_arrays, lambda source: source),
    "spikecv": ("spikecv", spikecv, lambda source: source),
    "recvidarreal": ("recvidarreal", recvidarreal, lambda source: source),
    "outdoor-spike": ("outdoor-spike", outdoor_spike, lambda source: source),
    "wision": ("wision", wision, lambda source: source),
    "wision bins": ("wision", wision_bins, lambda source: source.padded(SIDE)),
    "spice-hl3": ("spice-hl3", spice_hl3, lambda source: source.padded(SIDE)),
    "spice-hl3 pictures": ("spice-hl3", spice_hl3_pictures, lambda source: source),
}
"""Each layout of spikes: name of the data set, what writes it, and the frames that it then holds."""
