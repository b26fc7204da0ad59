"""OpenStack Swift as a server of S3 on this machine: `apt-get install liberasurecode-dev; pip install swift`.

Its programs are found in PATH. There is one replica on one device, and no cache. No updaters run, so the limits of time
are such that a slow machine does not miss what becomes of a listing.
"""

import shutil
import subprocess
from pathlib import Path

from ports import free_port

KEY = "spiked:storm"
"""Account and user."""
SECRET = "storm"
_COMMON = """
[swift-hash]
swift_hash_path_prefix = spiked
swift_hash_path_suffix = spiked

[storage-policy:0]
name = only
default = yes
"""
_SERVER = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
workers = 0
swift_dir = {folder}
devices = {folder}/devices
mount_check = false
log_level = WARNING
fallocate_reserve = 0
conn_timeout = 60
node_timeout = 60
container_update_timeout = 60

[pipeline:main]
pipeline = {kind}-server

[app:{kind}-server]
use = egg:swift#{kind}
"""
_PROXY = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
workers = 0
swift_dir = {folder}
log_level = WARNING

[pipeline:main]
pipeline = catch_errors gatekeeper listing_formats s3api tempauth copy bulk slo dlo versioned_writes proxy-server

[app:proxy-server]
use = egg:swift#proxy
account_autocreate = true
conn_timeout = 60
node_timeout = 60
error_suppression_interval = 1

[filter:s3api]
use = egg:swift#s3api
location = us-east-1

[filter:tempauth]
use = egg:swift#tempauth
user_spiked_storm = {secret} .admin
"""
_FILTERS = ("catch_errors", "gatekeeper", "listing_formats", "copy", "bulk", "slo", "dlo", "versioned_writes")
"""Those of the proxy without options."""
_KINDS = ("account", "container", "object")


def swift(folder: Path, port: int) -> list[list[str]]:
    """Write its files to a folder that is there. Return the commands of its servers, the proxy at `port` last."""
    (folder / "devices" / "one").mkdir(parents=True)
    (folder / "swift.conf").write_text(_COMMON)
    plain = "".join(f"\n[filter:{name}]\nuse = egg:swift#{name}\n" for name in _FILTERS)
    (folder / "proxy.conf").write_text(_PROXY.format(port=port, folder=folder, secret=SECRET) + plain)
    for kind in _KINDS:
        at, ring = free_port(), str(folder / f"{kind}.builder")
        (folder / f"{kind}.conf").write_text(_SERVER.format(port=at, folder=folder, kind=kind))
        for words in (["create", "4", "1", "0"], ["add", f"r1z1-127.0.0.1:{at}/one", "1"], ["rebalance"]):
            subprocess.run([_program("ring-builder"), ring, *words], check=True, capture_output=True)
    return [
        *([_program(f"{kind}-server"), str(folder / f"{kind}.conf"), "-v"] for kind in _KINDS),
        [_program("proxy-server"), str(folder / "proxy.conf"), "-v"],
    ]


def _program(name: str) -> str:
    found = shutil.which(f"swift-{name}")
    if found is None:
        raise SystemExit(f"swift-{name} is not in PATH: apt-get install liberasurecode-dev; pip install swift")
    return found
