"""Builds the container image of Debian's packages and that of spiked, without a base image or a container engine.

The layer is a Debian 12 made by mmdebstrap; around it this program writes the few JSON files of an OCI archive. With
SOURCE_DATE_EPOCH, by default the time of the last commit, the same packages give the same bytes. Needs root, or
user namespaces, for mmdebstrap, and the package that `deploy/build_debian.py` makes.

    python3.11 deploy/build_image.py dist/spiked_0.2.0_amd64.deb
    podman load -i dist/spiked-0.2.0-amd64.oci.tar
"""

import argparse
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from building import ROOT, epoch

UID = 8650
"""User and group of the service inside; a number, so that an engine can tell that it is not root."""
SUITE = "bookworm"
_ENVIRONMENT = {
    "PATH": "/usr/local/bin:/usr/bin:/bin",
    "HOME": "/data",
    "SPIKED_DATA": "/data",
    "SPIKED_HOST": "0.0.0.0",
    # ZeroMQ is for the same machine only, which in a container nobody else is.
    "SPIKED_ZMQ": "no",
    "SPIKED_LOG_FORMAT": "json",
}
_SECOND_NS = 1_000_000_000
_HEALTH = {"Test": ["CMD", "spiked", "health"], "Interval": 30 * _SECOND_NS, "Timeout": 10 * _SECOND_NS, "Retries": 3}


def file_system(package: Path, time: str, target: Path) -> None:
    """Write the layer, a tar file: Debian, the package, a user and its data folder."""
    inside = f"/tmp/{package.name}"
    hooks = [
        f"copy-in {package} /tmp",
        f'chroot "$1" groupadd --gid {UID} spiked && chroot "$1" useradd --uid {UID} --gid {UID} --home /data '
        "--no-create-home --shell /usr/sbin/nologin spiked",
        f'chroot "$1" apt-get install --yes --no-install-recommends {inside}',
        f'rm "$1{inside}" && rm -rf "$1"/var/lib/apt/lists/* "$1"/var/log/* "$1"/var/cache/* "$1"/etc/spiked',
        f'mkdir -m 0700 "$1/data" && chown {UID}:{UID} "$1/data"',
    ]
    command = ["mmdebstrap", "--quiet", "--variant=minbase", "--include=ca-certificates"]
    command += [f"--customize-hook={hook}" for hook in hooks]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": time, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run([*command, SUITE, target], env=environment, stdout=subprocess.DEVNULL, check=False)
    if done.returncode:
        sys.exit("error: mmdebstrap failed; its last lines say why")


def digest_of(data: bytes) -> str:
    """The name of a blob."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def compressed(layer: Path) -> tuple[Path, str]:
    """The layer as gzip without name and time, and the digest of what is inside."""
    target, inner = layer.with_suffix(".tar.gz"), hashlib.sha256()
    with (
        layer.open("rb") as source,
        target.open("wb") as raw,
        gzip.GzipFile(filename="", mode="wb", compresslevel=6, fileobj=raw, mtime=0) as packed,
    ):
        while piece := source.read(1 << 20):
            inner.update(piece)
            packed.write(piece)
    return target, f"sha256:{inner.hexdigest()}"


def file_digest(path: Path) -> str:
    """The name of a blob that is a file."""
    with path.open("rb") as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


def configuration(diff_id: str, architecture: str, version: str, time: str) -> dict[str, Any]:
    """The image's configuration: user, environment, what runs, health check."""
    created = f"{datetime.fromtimestamp(int(time), UTC):%Y-%m-%dT%H:%M:%SZ}"
    return {
        "created": created,
        "architecture": architecture,
        "os": "linux",
        "config": {
            "User": f"{UID}:{UID}",
            "Env": [f"{name}={value}" for name, value in _ENVIRONMENT.items()],
            "Entrypoint": ["spiked", "serve"],
            "WorkingDir": "/data",
            "Volumes": {"/data": {}},
            "ExposedPorts": {"8650/tcp": {}},
            "StopSignal": "SIGTERM",
            "Healthcheck": _HEALTH,
            "Labels": {
                "org.opencontainers.image.title": "spiked",
                "org.opencontainers.image.version": version,
                "org.opencontainers.image.licenses": "Apache-2.0",
            },
        },
        "rootfs": {"type": "layers", "diff_ids": [diff_id]},
        "history": [{"created": created, "created_by": "deploy/build_image.py"}],
    }


def described(kind: str, data: bytes) -> dict[str, Any]:
    """The descriptor of a JSON blob."""
    return {"mediaType": f"application/vnd.oci.image.{kind}.v1+json", "digest": digest_of(data), "size": len(data)}


def archive(layer: Path, architecture: str, version: str, time: str, target: Path) -> None:
    """Write the OCI archive of one layer."""
    packed, diff_id = compressed(layer)
    settings = json.dumps(configuration(diff_id, architecture, version, time)).encode()
    parts = {
        "schemaVersion": 2,
        "mediaType": "application/vnd.oci.image.manifest.v1+json",
        "config": described("config", settings),
        "layers": [
            {
                "mediaType": "application/vnd.oci.image.layer.v1.tar+gzip",
                "digest": file_digest(packed),
                "size": packed.stat().st_size,
            }
        ],
    }
    manifest = json.dumps(parts).encode()
    named = described("manifest", manifest) | {
        "annotations": {"org.opencontainers.image.ref.name": version},
        "platform": {"architecture": architecture, "os": "linux"},
    }
    index = json.dumps({"schemaVersion": 2, "manifests": [named]}).encode()
    with tarfile.open(target, "w", format=tarfile.GNU_FORMAT) as file:
        add(file, "oci-layout", json.dumps({"imageLayoutVersion": "1.0.0"}).encode(), time)
        add(file, "index.json", index, time)
        for blob in (settings, manifest):
            add(file, f"blobs/sha256/{digest_of(blob).removeprefix('sha256:')}", blob, time)
        name = f"blobs/sha256/{parts['layers'][0]['digest'].removeprefix('sha256:')}"  # type: ignore[index]
        member = entry(name, packed.stat().st_size, time)
        with packed.open("rb") as content:
            file.addfile(member, content)


def entry(name: str, size: int, time: str) -> tarfile.TarInfo:
    """The header of a file of the archive."""
    member = tarfile.TarInfo(name)
    member.size, member.mtime, member.mode = size, int(time), 0o644
    return member


def add(file: tarfile.TarFile, name: str, data: bytes, time: str) -> None:
    """Put a small file into the archive."""
    file.addfile(entry(name, len(data), time), io.BytesIO(data))


def main() -> None:
    """Build the image of the package that the command line names, and print its file."""
    parser = argparse.ArgumentParser(description="Build the container image of a Debian package, as an OCI archive.")
    parser.add_argument("package", type=Path, help="the package of this machine's processor")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the image; default: dist")
    asked = parser.parse_args()
    found = re.fullmatch(r"spiked_(.+)_(amd64|arm64)\.deb", asked.package.name)
    if found is None or not asked.package.is_file():
        sys.exit(f"error: {asked.package} is no package of spiked; deploy/build_debian.py makes it")
    if shutil.which("mmdebstrap") is None:
        sys.exit("error: there is no mmdebstrap: apt-get install mmdebstrap")
    time = epoch()
    asked.out.mkdir(parents=True, exist_ok=True)
    target = asked.out / f"spiked-{found[1]}-{found[2]}.oci.tar"
    with tempfile.TemporaryDirectory() as made:
        layer = Path(made, "layer.tar")
        file_system(asked.package.absolute(), time, layer)
        archive(layer, found[2], found[1], time, target)
    print(f"{target}  {target.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
