"""The virtual camera on the USB stack of a real kernel: a guest is booted once, and each test reads of one scene."""

import errno
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from machine import fetch_kernel, missing, run
from wire_facts import assert_sent, frames_of

pytestmark = pytest.mark.slow

HIGH, SUPER = 3, 4
READ_BYTES = 1 << 16


class Scenes:
    """What the guest reported, and the files it left."""

    def __init__(self, out: Path, console: str) -> None:
        self.out = out
        self._console = console
        report = out / "report.json"
        self._report: dict[str, Any] = json.loads(report.read_text()) if report.exists() else {}

    def __getitem__(self, name: str) -> Any:
        """A scene's report; if there is none, or it failed, the test fails with what there is to be read."""
        scene = self._report.get(name)
        if scene is None:
            pytest.fail(f"the guest did not come to {name!r}; its console:\n{self._console[-3000:]}")
        if "traceback" in scene:
            pytest.fail(f"in the guest:\n{scene['traceback']}")
        return scene


@pytest.fixture(scope="module")
def guest(pictures: Path, tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Scenes:
    if reason := missing():
        pytest.skip(reason)
    kernel = fetch_kernel(pytestconfig.cache.mkdir("kernel"))
    if kernel is None:
        pytest.skip("Debian's kernel package cannot be downloaded (apt-get download)")
    out = tmp_path_factory.mktemp("guest") / "out"
    out.mkdir()
    (out / "noise.dat").write_bytes(pictures.read_bytes())
    python = ["/usr/bin/env", f"PYTHONPATH={os.environ.get('PYTHONPATH', '')}", sys.executable]
    console = run(kernel, [*python, str(Path(__file__).parent / "inside.py"), "/tmp/out"], out)
    return Scenes(out, console)


def test_the_kernel_enumerates_cameras_of_the_same_serial_and_both_speeds(guest: Scenes) -> None:
    found = sorted(guest["listed"]["found"], key=lambda device: (device["bus"], device["ports"]))
    assert [(device["speed"], device["serial"]) for device in found] == [
        (HIGH, "17"),
        (SUPER, "000000000001"),
        (SUPER, "000000000001"),
    ]
    assert len({(device["bus"], *device["ports"]) for device in found}) == 3
    assert guest["listed"]["left"] == []


def test_what_is_read_through_the_kernel_is_what_was_sent(guest: Scenes, pictures: Path) -> None:
    scene = guest["read"]
    assert (scene["lengths"], scene["errno"], scene["requests"]) == ([READ_BYTES] * 8, None, 8)
    assert scene["configuration"].startswith("03041f60")
    assert len(scene["configuration"]) == 2 * 152
    frames = frames_of(guest.out / "read.wire")
    assert len(frames) == 8 * READ_BYTES // 13_016
    assert_sent(frames, pictures, (1 << 32) - 500)


def test_usbfs_refuses_what_the_mocked_one_refuses(guest: Scenes) -> None:
    assert guest["refused"] == {"limit": "16", "answer": [15, errno.ENOMEM]}


def test_the_kernel_gives_the_errors_of_the_mocked_one(guest: Scenes) -> None:
    errors = guest["troubled"]["errors"]
    assert errors[:2] == [errno.EPIPE, errno.EOVERFLOW]
    assert set(errors[2:]) == {errno.ETIMEDOUT}
    assert guest["troubled"]["reads"] == 12


def test_a_camera_pulled_out_while_it_is_read_is_found_at_another_port(guest: Scenes) -> None:
    scene = guest["pulled"]
    assert scene["first"]["errno"] in (errno.ENODEV, errno.EIO, errno.EPROTO, errno.ESHUTDOWN)
    assert scene["second"]["errno"] is None
    assert [device["ports"] for device in scene["found"]] == [[12]]
    assert scene["lines"][0] == 4


def test_poll_and_discard_are_as_in_the_mocked_one(guest: Scenes) -> None:
    assert guest["discarded"] == {"ready": [0, 1, 0], "same": True, "status": -errno.ENOENT, "actual": 0}


def test_the_driver_goes_on_through_trouble_on_a_real_kernel(guest: Scenes) -> None:
    scene = guest["driven"]
    assert scene["received"] + sum(count for _, count, _ in scene["gaps"]) == scene["end"]
    assert scene["sent"], "a frame came that was not sent, or under another's number"
    *before, unplugged = scene["gaps"]
    # Under emulation on a busy machine the camera's own buffer may run over, too: then more are dropped.
    assert max(count for _, count, cause in before if cause == "device") >= 7
    assert unplugged[2] == "device"
    states = [state for state, _ in scene["states"]]
    assert states.count("lost") == 3
    assert "absent" in states
    assert states[-1] == "streaming"
    assert scene["closed_s"] < 3.0  # under emulation
