"""Stores of `measure_cluster.py`: a folder, or S3 by a server of this machine, behind a proxy that makes faults."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from faulty_proxy import FaultyProxy

BUCKET = "spiked-storm"
STALL_S = 90.0
"""Longer than any of the limits of the object store."""
KEY = "S3RVER"
"""Key and secret of s3rver, which has no others; moto takes any."""


def moto(folder: Path, port: int) -> list[str]:
    """The command of moto's server, which keeps objects in memory."""
    return [str(Path(sys.executable).with_name("moto_server")), "-H", "127.0.0.1", "-p", str(port)]


def s3rver(folder: Path, port: int) -> list[str]:
    """The command of s3rver, which keeps objects in a folder: `npm install s3rver`."""
    program = shutil.which("s3rver")
    if program is None:
        raise SystemExit(
            "s3rver is not in PATH: npm install --prefix FOLDER s3rver, PATH=FOLDER/node_modules/.bin:$PATH"
        )
    return [program, "--directory", str(folder), "--address", "127.0.0.1", "--port", str(port), "--silent"]


SERVERS: dict[str, Callable[[Path, int], list[str]]] = {"s3-moto": moto, "s3-s3rver": s3rver}


@dataclass(frozen=True)
class Store:
    """Where files are left for the other side."""

    uri: str
    port: int
    proxy: FaultyProxy

    def left(self) -> dict[str, int | None]:
        """What is there, recordings apart, and uploads that nobody has ended; None for what cannot be listed.

        It is read without the proxy.
        """
        import s3fs

        files = s3fs.S3FileSystem(endpoint_url=f"http://127.0.0.1:{self.port}", use_listings_cache=False)
        objects = None
        with suppress(OSError):  # a request that was cut off may have broken the listings of s3rver for good
            objects = len([one for one in files.find(self.uri) if "/recordings/" not in one])
        uploads = None
        with suppress(OSError):  # s3rver has no such request
            uploads = len(files.list_multipart_uploads(BUCKET))
        return {"left_in_store": objects, "uploads_left": uploads}


def s3_store(kind: str, folder: Path, port: int, ends: ExitStack) -> Store:
    """Start a server and the proxy, whose address and keys are in the environment of what is started from now on."""
    (folder / "s3").mkdir()
    with (folder / "s3.log").open("wb") as log:
        server = subprocess.Popen(SERVERS[kind](folder / "s3", port), stdout=log, stderr=log)
    ends.callback(server.wait)
    ends.callback(server.terminate)
    until_s = time.monotonic() + 60
    while True:
        with suppress(httpx.TransportError):
            httpx.get(f"http://127.0.0.1:{port}/")
            break
        if server.poll() is not None or time.monotonic() > until_s:
            raise SystemExit(f"{kind} does not start: {(folder / 's3.log').read_text()[-2000:]}")
        time.sleep(0.2)
    proxy = ends.enter_context(FaultyProxy(port, stall_s=STALL_S))
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        del os.environ[name]
    os.environ |= {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": KEY, "AWS_DEFAULT_REGION": "us-east-1"}
    os.environ["AWS_ENDPOINT_URL"] = proxy.url
    import s3fs

    s3fs.S3FileSystem().mkdir(BUCKET)
    return Store(f"s3://{BUCKET}/jobs", port, proxy)
