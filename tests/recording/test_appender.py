"""Files that grow past the page cache."""

import errno
import fcntl
import os
import resource
import signal
from pathlib import Path

import numpy as np
import pytest

from spiked.recording.appender import Appender


def content(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, count, np.uint8)


def test_appends_of_any_length_follow_each_other_and_whole_pages_go_directly(disk: Path) -> None:
    rng = np.random.default_rng(1)
    lengths = [1, 4095, 1, 70_000, 100_000, 4096, 65_536, 9 << 20, *rng.integers(1, 300_000, 40)]
    expected = content(int(np.sum(lengths)))
    file = Appender(disk / "a", resume=False, direct=True)
    at = 0
    for number, length in enumerate(lengths):
        file.append(expected[at : at + length], cached=number % 7 == 6)
        at += int(length)
        assert file.size == (disk / "a").stat().st_size == at
    assert 0.6 * at < file.direct_bytes < at
    file.close()
    assert (np.fromfile(disk / "a", np.uint8) == expected).all()


def test_goes_on_behind_what_is_there_and_behind_a_cut(disk: Path) -> None:
    expected = content(1_000_000)
    file = Appender(disk / "a", resume=False, direct=True)
    file.append(expected[:300_001])
    file.close()
    file = Appender(disk / "a", resume=True, direct=True)
    file.append(expected[300_001:700_000])
    file.append(content(200_000, seed=2))
    file.cut(700_000)
    file.append(expected[700_000:])
    assert file.direct_bytes > 500_000
    file.close()
    assert (np.fromfile(disk / "a", np.uint8) == expected).all()


def test_a_reader_sees_every_append_at_once(disk: Path) -> None:
    """Also one that has just read the pages that are written next to, or has the file mapped."""
    expected = content(2_000_000)
    file = Appender(disk / "a", resume=False, direct=True)
    for at in range(0, len(expected), 125_000):
        file.append(expected[at : at + 125_000])
        assert (np.fromfile(disk / "a", np.uint8) == expected[: at + 125_000]).all()
        assert (np.memmap(disk / "a", np.uint8, "r") == expected[: at + 125_000]).all()
        os.fdatasync(file.fileno())
    file.close()


def test_a_file_system_without_direct_writes_is_written_as_any(disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.open

    def refusing(path: Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_DIRECT:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return real(path, flags, mode)

    monkeypatch.setattr(os, "open", refusing)
    expected = content(500_000)
    file = Appender(disk / "a", resume=False, direct=True)
    file.append(expected)
    assert file.direct_bytes == 0
    file.close()
    assert (np.fromfile(disk / "a", np.uint8) == expected).all()


def test_direct_writes_that_are_refused_later_are_done_as_any(disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some file systems open a file for direct writes and then refuse the writes."""
    real = os.pwrite

    def refusing(file: int, data: bytes, offset: int) -> int:
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_DIRECT:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return real(file, data, offset)

    monkeypatch.setattr(os, "pwrite", refusing)
    expected = content(500_000)
    file = Appender(disk / "a", resume=False, direct=True)
    file.append(expected)
    file.append(expected)
    assert file.direct_bytes == 0
    file.close()
    assert (np.fromfile(disk / "a", np.uint8) == np.tile(expected, 2)).all()


def test_a_limit_within_direct_writes_is_told_as_what_it_is(disk: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    file = Appender(disk / "a", resume=False, direct=True)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (250_001, before[1]))
        file.append(content(200_000))
        with pytest.raises(OSError) as caught:
            file.append(content(200_000, seed=2))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert caught.value.errno == errno.EFBIG
    file.cut(200_000)
    file.close()
    assert (np.fromfile(disk / "a", np.uint8) == content(200_000)).all()
