"""The container image in an OCI runtime, without an engine: `make packages` makes it, crun runs it."""

import json
import os
import shutil
import ssl
import subprocess
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from certificates import certificate
from ports import free_port
from waiting import until

DIST = Path(__file__).parents[1] / "dist"
FRAMES = 1280
TOKEN = "a-token-of-this-test-0123456789"
TOOLS = "crun", "umoci", "unshare"
NAME = f"spiked-test-{os.getpid()}"
IN_ONE_HIERARCHY = "umount -l /sys/fs/cgroup/unified 2>/dev/null; exec crun --cgroup-manager=disabled"
"""crun refuses machines that have both versions of control groups; its own mount namespace hides the newer one."""


def crun(*arguments: str | Path) -> list[str | Path]:
    return ["unshare", "--mount", "sh", "-c", f'{IN_ONE_HIERARCHY} "$@"', "crun", *arguments]


def bundle_of(image: Path, folder: Path, port: int) -> Path:
    """The unpacked image, with a token, a certificate, a port and the network of this machine."""
    layout, bundle, tls = folder / "layout", folder / "bundle", folder / "tls"
    with tarfile.open(image) as archive:
        archive.extractall(layout, filter="data")
    (manifest,) = json.loads((layout / "index.json").read_text())["manifests"]
    tag = manifest["annotations"]["org.opencontainers.image.ref.name"]
    subprocess.run(["umoci", "unpack", "--image", f"{layout}:{tag}", bundle], check=True, capture_output=True)
    tls.mkdir()
    chain, key = certificate(tls, "localhost")
    key.chmod(0o644)  # the service is not root
    config = bundle / "config.json"
    made = json.loads(config.read_text())
    assert made["process"]["user"]["uid"] == 8650
    made["process"]["terminal"] = False
    made["process"]["args"] += ["--device", "sim:", "--frames", str(FRAMES)]
    made["process"].pop("oomScoreAdj", None)  # may not be lowered everywhere
    given = {"TOKEN": TOKEN, "PORT": str(port), "TLS_CERTIFICATE": f"/tls/{chain.name}", "TLS_KEY": f"/tls/{key.name}"}
    made["process"]["env"] += [f"SPIKED_{name}={value}" for name, value in given.items()]
    made["mounts"] = [one for one in made["mounts"] if one["destination"] != "/sys/fs/cgroup"]
    made["mounts"].append({"destination": "/tls", "type": "bind", "source": str(tls), "options": ["bind", "ro"]})
    for one in made["mounts"]:
        if one["destination"] == "/dev/shm":
            one["options"] = [option for option in one["options"] if not option.startswith("size=")] + ["size=1g"]
    linux = made["linux"]
    linux["namespaces"] = [one for one in linux["namespaces"] if one["type"] != "network"]
    linux.pop("resources", None)
    linux.pop("cgroupsPath", None)
    config.write_text(json.dumps(made))
    return bundle


@contextmanager
def running(bundle: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The container, which is gone afterwards."""
    process = subprocess.Popen(crun("run", "--bundle", bundle, NAME))
    try:
        yield process
    finally:
        if process.poll() is None:
            subprocess.run(crun("delete", "--force", NAME), check=False)
        process.wait()


@pytest.mark.slow
def test_the_image_serves_in_an_oci_runtime_with_tls_and_a_token(tmp_path: Path) -> None:
    images = sorted(DIST.glob("spiked-*.oci.tar"))
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing or os.getuid() != 0 or not images:
        pytest.skip(f"needs root, an image in dist (make packages) and {', '.join(TOOLS)}")
    port = free_port()
    trusted = ssl.create_default_context()
    trusted.check_hostname, trusted.verify_mode = False, ssl.CERT_NONE
    with running(bundle_of(images[-1], tmp_path, port)) as process:
        with httpx.Client(base_url=f"https://127.0.0.1:{port}", verify=trusted, timeout=60) as http:

            def answers() -> bool:
                assert process.poll() is None
                try:
                    return http.get("/healthz").status_code < 500
                except httpx.TransportError:
                    return False

            until(answers, "the service answers")
            assert http.get("/api/v1/captures").status_code == 401
            http.headers["Authorization"] = f"Bearer {TOKEN}"

            def scene() -> object:
                jobs = http.get("/api/v1/reconstructions").json()["items"]
                return jobs and jobs[0]["splats"]

            until(scene, "the first scene")
            (capture,) = http.get("/api/v1/captures").json()["items"]
            own = f"/api/v1/captures/{capture['id']}"
            until(lambda: http.get(own).json()["state"] == "complete", "the capture is over")
            recorded = http.get(own).json()["recording"]
            assert (recorded["frames"], recorded["lost"]) == (FRAMES, 0)
        command = crun("exec", "--user", "8650:8650", NAME, "spiked", "health")
        health = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (health.returncode, health.stdout.split()[0]) == (0, "ok")
        subprocess.run(crun("kill", NAME, "TERM"), check=True)
        assert process.wait(60) == 0
