"""A virtual machine with Debian's kernel, started from packages: no image, no network, no right to do anything special.

The guest's root file system is this machine's, read-only (virtio-9p); an initramfs of busybox and the modules needed
mounts it. What the guest says comes back in a folder that it may write, and its console in a file there.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

KERNEL = "linux-image-amd64"
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "usbcore", "vhci-hcd")
TOOLS = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "udevadm": "udev"}
"""Programs and the Debian packages that have them."""

_INIT = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /root
/bin/busybox mount -t proc proc /proc
for module in {modules}; do /bin/busybox insmod /modules/$module.ko; done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=500000 root /root
/bin/busybox mount -t proc proc /root/proc
/bin/busybox mount -t sysfs sysfs /root/sys
/bin/busybox mount -t devtmpfs devtmpfs /root/dev
/bin/busybox mkdir -p /root/dev/shm
/bin/busybox mount -t tmpfs tmpfs /root/dev/shm
/bin/busybox mount -t tmpfs tmpfs /root/tmp
/bin/busybox mount -t tmpfs tmpfs /root/run
/bin/busybox mkdir /root/tmp/out
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=500000 out /root/tmp/out
export SYSTEMD_IGNORE_CHROOT=1
/bin/busybox ip link set lo up
/bin/busybox chroot /root /lib/systemd/systemd-udevd --daemon
/bin/busybox chroot /root {command} >/dev/console 2>&1
/bin/busybox sync
/bin/busybox poweroff -f
"""


def missing() -> str | None:
    """Why no guest can be started here, None if one can."""
    packages = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if not Path("/lib/systemd/systemd-udevd").exists() and "udev" not in packages:
        packages.append("udev")
    return f"not installed: {' '.join(packages)} (apt-get install {' '.join(packages)})" if packages else None


def fetch_kernel(folder: Path) -> Path | None:
    """Debian's kernel unpacked into the folder, without installing it; None if no mirror is within reach."""
    name = _newest_kernel()
    if name is None and os.geteuid() == 0:
        subprocess.run(["apt-get", "update", "-q"], capture_output=True, check=False)
        name = _newest_kernel()
    if name is None:
        return None
    tree = folder / name
    if not tree.exists():
        if subprocess.run(["apt-get", "download", name], cwd=folder, capture_output=True, check=False).returncode:
            return None
        package = next(folder.glob(f"{name}_*.deb"))
        part = folder / "unpacking"
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run(["dpkg-deb", "-x", package, part], check=True)
        package.unlink()
        part.rename(tree)
    return tree


def _newest_kernel() -> str | None:
    """The package that KERNEL stands for, None if the lists of packages are not here."""
    depends = subprocess.run(["apt-cache", "depends", KERNEL], capture_output=True, text=True, check=False).stdout
    found = re.search(r"Depends: (linux-image-\S+)", depends)
    return found[1] if found else None


def run(kernel: Path, command: Sequence[str], out: Path, *, memory_mb: int = 1536, timeout_s: float = 600.0) -> str:
    """Boot, run the command as root with /tmp/out in `out`, power off; what the console said.

    Raises TimeoutExpired if the guest does not come to its end.
    """
    work = out.parent / "initramfs"
    modules = _modules(kernel)
    (work / "bin").mkdir(parents=True)
    (work / "modules").mkdir()
    (work / "dev").mkdir()
    shutil.copy(shutil.which("busybox") or "", work / "bin/busybox")
    for module in modules:
        shutil.copy(module, work / "modules" / module.name)
    init = work / "init"
    quoted = " ".join(f"'{word}'" for word in command)
    init.write_text(_INIT.format(modules=" ".join(module.stem for module in modules), command=quoted))
    init.chmod(0o755)
    names = "\n".join(str(path.relative_to(work)) for path in sorted(work.rglob("*")))
    archive = out.parent / "initramfs.cpio"
    with archive.open("wb") as file:
        subprocess.run(
            ["busybox", "cpio", "-o", "-H", "newc"],
            cwd=work,
            input=names.encode(),
            stdout=file,
            check=True,
            stderr=subprocess.DEVNULL,
        )
    shared = "security_model=none,multidevs=remap"
    arguments = ["qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "Nehalem", "-smp", "2"]
    arguments += ["-m", str(memory_mb), "-nographic", "-no-reboot", "-nodefaults", "-serial", "stdio"]
    arguments += ["-kernel", str(next((kernel / "boot").glob("vmlinuz-*"))), "-initrd", str(archive)]
    arguments += ["-append", "console=ttyS0 quiet panic=-1 mitigations=off"]
    arguments += ["-virtfs", f"local,path=/,mount_tag=root,readonly=on,{shared}"]
    arguments += ["-virtfs", f"local,path={out},mount_tag=out,{shared}"]
    done = subprocess.run(
        arguments,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=timeout_s,
        check=False,
    )
    return done.stdout.decode(errors="replace")


def _modules(kernel: Path) -> list[Path]:
    """The files of MODULES and of what they need, each behind what it needs itself."""
    files = {path.stem.replace("-", "_"): path for path in kernel.rglob("*.ko")}
    ordered: list[Path] = []

    def add(name: str) -> None:
        path = files[name.replace("-", "_")]
        if path in ordered:
            return
        depends = re.search(rb"\0depends=([^\0]*)\0", path.read_bytes())
        for other in (depends[1].decode() if depends else "").split(","):
            if other:
                add(other)
        ordered.append(path)

    for name in MODULES:
        add(name)
    return ordered
