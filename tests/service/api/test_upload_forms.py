"""Uploads of arrays, photon cubes and raw camera bytes: converted in the worker as by `spiked convert`."""

import os
import signal
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from spiked_driver.framing import encode_usb
from spiked_driver.pcie import encode_pcie

from spiked.client import ApiError, GeometryModel

from .conftest import Service

FRAMES = 150
NO_HDF5 = "h5py is not installed: pip install 'spiked[hdf5]'"


def spikes(width: int = 24, height: int = 16) -> NDArray[np.uint8]:
    return np.random.default_rng(width).integers(0, 2, (FRAMES, height, width), np.uint8)


def saved_npz(path: Path, array: NDArray[np.uint8]) -> None:
    np.savez_compressed(path, spikes=array, other=np.zeros_like(array), times=np.arange(3.0))


def saved_hdf5(path: Path, array: NDArray[np.uint8]) -> None:
    h5py = pytest.importorskip("h5py", reason=NO_HDF5)
    with h5py.File(path, "w") as file:
        file.create_dataset("spikes", data=array, chunks=(16, *array.shape[1:]), compression="gzip")


def stored(service: Any, capture: Any) -> NDArray[np.uint8]:
    """The content of its recording, uint8 [n, frame_bytes]."""
    data = service.http.get(f"captures/{capture.id}/recording").content
    return np.frombuffer(data, np.uint8).reshape(capture.recording.frames, -1)


def packed(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.packbits(frames, axis=2, bitorder="little").reshape(len(frames), -1)


def refused(service: Any, path: Path, **more: Any) -> str:
    """Why the upload was refused. It can be removed."""
    with pytest.raises(ApiError) as error:
        service.client.upload(path, **more)
    assert error.value.status in (422, 507), str(error.value)
    for upload in service.http.get("uploads").json()["items"]:
        assert service.http.delete(f"uploads/{upload['id']}").status_code == 204
    return str(error.value)


@pytest.mark.parametrize(
    ("name", "save", "array"), [("a.npy", np.save, None), ("a.npz", saved_npz, "spikes"), ("a.h5", saved_hdf5, None)]
)
def test_an_array_becomes_a_recording(
    service: Any, tmp_path: Path, name: str, save: Callable[..., None], array: str | None
) -> None:
    save(tmp_path / name, spikes())
    geometry = GeometryModel(rate=40_000, mosaic="BGGR", fov=50)
    capture = service.client.upload(tmp_path / name, geometry=geometry, array=array)
    np.testing.assert_array_equal(stored(service, capture), packed(spikes()))
    sensor = capture.sensor
    assert (sensor.width, sensor.height, sensor.frame_rate_hz, sensor.mosaic) == (24, 16, 40_000, "BGGR")
    assert sensor.intrinsics is not None
    assert any("which way up its rows come" in text for text in capture.warnings)


def test_a_photon_cube_becomes_a_recording(service: Any, tmp_path: Path) -> None:
    frames = spikes(512, 4)
    np.save(tmp_path / "cube.npy", np.packbits(frames, axis=2))
    capture = service.client.upload(tmp_path / "cube.npy", geometry=GeometryModel(rate=97_700, flipped=False))
    np.testing.assert_array_equal(stored(service, capture), packed(frames))
    assert not any("which way up" in text for text in capture.warnings)


def test_bits_become_a_recording(service: Any, tmp_path: Path) -> None:
    frames = spikes(20, 6)
    bits = np.packbits(frames.reshape(FRAMES, -1), axis=1, bitorder="little")
    (tmp_path / "vidar.dat").write_bytes(bits.tobytes())
    geometry = GeometryModel(width=20, height=6, rate=20_000)
    capture = service.client.upload(tmp_path / "vidar.dat", geometry=geometry, form="bits")
    np.testing.assert_array_equal(stored(service, capture), packed(frames[:, :, :16]))
    assert any("4 of 20 columns are left out" in text for text in capture.warnings)


@pytest.mark.parametrize(
    ("frame_bytes", "encode", "form"), [(12_500, encode_usb, None), (125_000, encode_pcie, "pcie")]
)
def test_raw_camera_bytes_become_a_recording(
    service: Any, tmp_path: Path, frame_bytes: int, encode: Callable[..., NDArray[np.uint8]], form: str | None
) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (20, frame_bytes), np.uint8)
    (tmp_path / "raw.bin").write_bytes(encode(frames).tobytes())
    capture = service.client.upload(tmp_path / "raw.bin", form=form)
    np.testing.assert_array_equal(stored(service, capture), frames)


def test_lost_frames_of_raw_bytes_are_counted(service: Any, tmp_path: Path) -> None:
    frames = np.zeros((20, 12_500), np.uint8)
    raw = np.concatenate([encode_usb(frames[:10]).ravel(), encode_usb(frames[10:], first=17).ravel()])
    (tmp_path / "raw.bin").write_bytes(raw.tobytes())
    recording = service.client.upload(tmp_path / "raw.bin").recording
    assert (recording.frames, recording.lost) == (20, 7)


def hdf5_bomb(path: Path, frames: int) -> None:
    """Chunks that were never written."""
    h5py = pytest.importorskip("h5py", reason=NO_HDF5)
    with h5py.File(path, "w") as file:
        file.create_dataset("spikes", (frames, 64, 64), "u1", chunks=(64, 64, 64), compression="gzip")


def npz_bomb(path: Path, frames: int) -> None:
    """A header of many frames, and 64 MiB of zeros."""
    header = {"descr": "|u1", "fortran_order": False, "shape": (frames, 64, 64)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(64):
            file.write(bytes(1 << 20))


@pytest.mark.parametrize("bomb", [hdf5_bomb, npz_bomb])
def test_a_file_that_unpacks_beyond_the_limit_or_the_disk_is_refused(
    daemon: Any, tmp_path: Path, bomb: Callable[[Path, int], None]
) -> None:
    one = Service(daemon("--set", f"limit_upload_bytes={1 << 38}"))
    free = one.http.get("system").json()["disk"]["free_bytes"]
    bomb(tmp_path / "bomb.bin", 1 << 30)
    assert f"more than the limit of {1 << 38} for an upload" in refused(one, tmp_path / "bomb.bin")
    frames = min(free, (1 << 38) - 512) // 512
    assert frames * 512 > free - (1 << 30), "the disk is the limit"
    bomb(tmp_path / "bomb.bin", frames)
    assert "do not fit" in refused(one, tmp_path / "bomb.bin")
    assert list((tmp_path / "data" / "uploads").iterdir()) == []
    assert one.http.post("uploads", json={"name": "a", "bytes": free // 2}).status_code == 201, "nothing is reserved"


def test_frames_of_two_gigabytes_end_the_worker_only(service: Any, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason=NO_HDF5)
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("spikes", (16, 16_384, 16_384), "f8", chunks=(1, 16_384, 16_384), compression="gzip")
    told = refused(service, tmp_path / "bomb.h5")
    assert "chunks of [1, 16384, 16384], which are more than 1024 MiB" in told
    assert service.http.get("captures").status_code == 200


@pytest.mark.parametrize(("name", "save"), [("a.npz", saved_npz), ("a.h5", saved_hdf5)])
def test_a_damaged_array_is_told(service: Any, tmp_path: Path, name: str, save: Callable[..., None]) -> None:
    path = tmp_path / name
    save(path, np.random.default_rng(0).integers(0, 2, (4000, 16, 24), np.uint8))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 5000] = bytes(5000)
    path.write_bytes(content)
    told = refused(service, path, array="spikes")
    assert "the file is damaged" in told
    assert name in told and "/uploads/" not in told


def test_pickled_and_strange_arrays_are_refused(service: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for array, told in (
        (np.array([[{"a": 1}]], object), "readable"),
        (np.full((4, 8, 8), 2.5), "other values than 0 and 1"),
        (np.zeros((4, 8), np.uint8), "shape"),
        (np.zeros((1, 1, 20_000), np.uint8), "larger than 16384"),
    ):
        np.save(path, array, allow_pickle=True)
        assert told in refused(service, path)


def test_an_array_that_lies_in_another_file_is_not_followed(service: Any, tmp_path: Path) -> None:
    """An uploaded file must not bring bytes of this machine into a recording."""
    h5py = pytest.importorskip("h5py", reason=NO_HDF5)
    secret, target = tmp_path / "secret", tmp_path / "target.h5"
    secret.write_bytes(os.urandom(4096))
    with h5py.File(target, "w") as file:
        file["spikes"] = np.frombuffer(secret.read_bytes(), np.uint8).reshape(8, 16, 32)
    with h5py.File(tmp_path / "external.h5", "w") as file:
        file.create_dataset("spikes", (8, 16, 32), "u1", external=[(str(secret), 0, 4096)])
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((8, 16, 32), "u1")
        layout[:] = h5py.VirtualSource(str(target), "spikes", (8, 16, 32))
        file.create_virtual_dataset("spikes", layout)
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["spikes"] = h5py.ExternalLink(str(target), "spikes")
    for name, told in (("external", "in other files"), ("virtual", "in other files"), ("link", "no array")):
        assert told in refused(service, tmp_path / f"{name}.h5")


def test_what_does_not_belong_together_is_refused(service: Any, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", spikes())
    assert "holds none" in refused(service, tmp_path / "a.npy", form="pcie", array="x")
    assert "width and the height" in refused(service, tmp_path / "a.npy", form="bits")
    assert "24 columns, not 32" in refused(service, tmp_path / "a.npy", geometry=GeometryModel(width=32))
    body = {"name": "a.npy", "bytes": 10, "form": "zip"}
    assert service.http.post("uploads", json=body).status_code == 422


def test_a_killed_worker_leaves_nothing_and_the_upload_can_be_completed(daemon: Any, tmp_path: Path) -> None:
    one = daemon()
    path = tmp_path / "long.npz"
    np.savez_compressed(path, spikes=np.random.default_rng(0).integers(0, 2, (6000, 128, 256), np.uint8))
    upload = one.http.post("uploads", json={"name": "long", "bytes": path.stat().st_size}).json()["id"]
    headers = {"Content-Type": "application/octet-stream", "Upload-Offset": "0"}
    with path.open("rb") as content:
        assert one.http.patch(f"uploads/{upload}", content=content.read(), headers=headers).status_code == 200
    converted = tmp_path / "data" / "uploads" / f"{upload}.dat"
    with ThreadPoolExecutor(1) as threads:
        answer = threads.submit(one.http.post, f"uploads/{upload}:complete")
        deadline = time.monotonic() + 60
        while not converted.exists():
            assert time.monotonic() < deadline and not answer.done()
            time.sleep(0.005)
        children = psutil.Process(one.process.pid).children(recursive=True)
        (worker,) = (child for child in children if child.cmdline()[-1:] == ["upload"])
        worker.send_signal(signal.SIGKILL)
        told = answer.result()
    assert told.status_code == 422 and "killed by signal 9" in told.json()["detail"]
    assert not converted.exists()
    done = one.http.post(f"uploads/{upload}:complete")
    assert (done.status_code, done.json()["recording"]["frames"]) == (201, 6000)
    assert list(converted.parent.glob("*.dat")) == []
