"""Stores of `measure_cluster.py`: a folder, or S3 by a server of this machine, behind a proxy that makes faults."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from faulty_proxy import FaultyProxy
from swift_server import KEY, SECRET, swift

BUCKET = "spiked-storm"
STALL_S = 90.0
"""Longer than any of the limits of the object store."""
START_S = 120.0
"""Time for a server to make a bucket."""


def moto(folder: Path, port: int) -> list[list[str]]:
    """The command of moto's server, which keeps objects in memory and takes any key."""
    return [[str(Path(sys.executable).with_name("moto_server")), "-H", "127.0.0.1", "-p", str(port)]]


SERVERS: dict[str, Callable[[Path, int], list[list[str]]]] = {"s3-moto": moto, "s3-swift": swift}
"""Each with what returns the commands of its processes."""


@dataclass(frozen=True)
class Store:
    """Where files are left for the other side."""

    uri: str
    port: int
    proxy: FaultyProxy

    def left(self) -> dict[str, int]:
        """What is there, recordings apart, and uploads that nobody has ended. It is read without the proxy."""
        files = _without_proxy(self.port)
        return {
            "left_in_store": len([one for one in files.find(self.uri) if "/recordings/" not in one]),
            "uploads_left": len(files.list_multipart_uploads(BUCKET)),
        }


def s3_store(kind: str, folder: Path, port: int, host: str, ends: ExitStack) -> Store:
    """Start a server, and the proxy at an address of this machine.

    Its address and keys are in the environment of what is started from now on.
    """
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        del os.environ[name]
    os.environ |= {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_DEFAULT_REGION": "us-east-1"}
    (folder / "s3").mkdir()
    for command in SERVERS[kind](folder / "s3", port):
        with (folder / "s3.log").open("ab") as log:
            server = subprocess.Popen(command, stdout=log, stderr=log)
        ends.callback(server.wait)
        ends.callback(server.kill)
    until_s = time.monotonic() + START_S
    while True:
        try:
            _without_proxy(port).mkdir(BUCKET)
            break
        except OSError as error:
            if time.monotonic() > until_s:
                told = (folder / "s3.log").read_text()[-2000:]
                raise SystemExit(f"{kind} makes no bucket: {error}\n{told}") from error
        time.sleep(0.5)
    proxy = ends.enter_context(FaultyProxy(port, stall_s=STALL_S, host=host))
    os.environ["AWS_ENDPOINT_URL"] = proxy.url
    return Store(f"s3://{BUCKET}/jobs", port, proxy)


def _without_proxy(port: int) -> Any:
    """The files of a server."""
    import s3fs

    return s3fs.S3FileSystem(endpoint_url=f"http://127.0.0.1:{port}", use_listings_cache=False)
