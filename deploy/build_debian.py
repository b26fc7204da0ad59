"""Builds the Debian 12 package: the wheel and what it needs below /opt/spiked, unit, udev rule, settings, user.

Debian 12 has most of these packages in older versions than spiked needs, so they are inside; Python itself and libusb
are Debian's. Needs dpkg-deb, python3.11 with pip, and a wheel of CPython 3.11 (make wheel).

    python3.11 deploy/build_debian.py dist/spiked-0.2.0-cp311-cp311-linux_x86_64.whl
"""

import argparse
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path

from building import DEPLOY, ROOT, epoch, run
from sbom import bill

PREFIX = Path("opt/spiked")
SITE = PREFIX / "lib/python3.11/site-packages"
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}
DEPENDS = "python3.11, libusb-1.0-0, adduser"
_LAUNCHER = """#!/opt/spiked/bin/python3.11 -P
from spiked_service.cli.program import main

main()
"""


def add_program(root: Path, wheel: Path) -> None:
    """Fill /opt/spiked: an environment of Debian's Python with the wheel and what it needs."""
    site = root / SITE
    site.mkdir(parents=True)
    run(
        sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile",
        "--no-warn-conflicts", "--only-binary=:all:", "--target", site, wheel,
    )  # fmt: skip
    shutil.rmtree(site / "bin", ignore_errors=True)
    for folder in [*site.rglob("__pycache__"), *site.glob("*/**/tests")]:
        if folder.is_dir() and not folder.is_relative_to(site / "spiked"):
            shutil.rmtree(folder)
    for file in site.glob("*.dist-info/direct_url.json"):
        file.unlink()  # the folder of the build
    compile_modules(root)
    programs = root / PREFIX / "bin"
    programs.mkdir()
    for name in ("python3.11", "python3", "python"):
        (programs / name).symlink_to("/usr/bin/python3.11")
    (root / PREFIX / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11\n")
    write(programs / "spiked", _LAUNCHER, 0o755)
    (root / "usr/bin").mkdir(parents=True)
    (root / "usr/bin/spiked").symlink_to("/opt/spiked/bin/spiked")


def compile_modules(root: Path) -> None:
    """Write the bytecode of all modules. The service runs as a user that cannot, so that each start would compile anew
    what it imports. Python takes it without a look at the sources, which nobody changes in place."""
    run(
        sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash", "-s", root, "-p", "/",
        root / SITE, PYTHONHASHSEED="0",
    )  # fmt: skip


def add_system(root: Path) -> None:
    """Unit, udev rule, settings, licence, bill of materials."""
    for source, target in {
        "deploy/systemd/spiked.service": "lib/systemd/system/spiked.service",
        "deploy/udev/70-spiked.rules": "lib/udev/rules.d/70-spiked.rules",
        "deploy/spiked.toml": "etc/spiked/spiked.toml",
        "LICENSE": "usr/share/doc/spiked/copyright",
        "CHANGELOG.md": "usr/share/doc/spiked/CHANGELOG.md",
    }.items():
        write(root / target, (ROOT / source).read_text())
    write(root / "usr/share/doc/spiked/sbom.json", json.dumps(bill(root / SITE), indent=1) + "\n")


def add_control(root: Path, version: str, architecture: str) -> None:
    """The folder DEBIAN."""
    size = sum(file.lstat().st_size for file in root.rglob("*") if not file.is_dir()) >> 10
    fields = {
        "Package": "spiked",
        "Version": version,
        "Architecture": architecture,
        "Maintainer": "The authors of spiked <spiked@localhost>",
        "Installed-Size": str(size),
        "Depends": DEPENDS,
        "Section": "science",
        "Priority": "optional",
        "Description": "acquisition and 3D reconstruction for spike cameras\n"
        " A service that records spike cameras, and reconstructs camera trajectory and\n"
        " Gaussian splats while it records. With a web page and a REST API on port 8650.",
    }
    write(root / "DEBIAN/control", "".join(f"{name}: {text}\n" for name, text in fields.items()))
    write(root / "DEBIAN/conffiles", "/etc/spiked/spiked.toml\n")
    for script in ("postinst", "prerm", "postrm"):
        write(root / "DEBIAN" / script, (DEPLOY / "debian" / script).read_text(), 0o755)


def write(path: Path, text: str, mode: int = 0o644) -> None:
    """Write a file with these permissions, and the folders that it needs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(mode)


def build(wheel: Path, out: Path) -> Path:
    """The package of a wheel, in the folder `out`."""
    found = re.fullmatch(r"spiked-([^-]+)-cp311-cp311-\w*?(x86_64|aarch64)\.whl", wheel.name)
    if found is None:
        sys.exit(f"error: {wheel.name} is no wheel of CPython 3.11, which Debian 12 has: make wheels")
    version, architecture = found[1], ARCHITECTURES[found[2]]
    out.mkdir(parents=True, exist_ok=True)
    package = out / f"spiked_{version}_{architecture}.deb"
    with tempfile.TemporaryDirectory() as made:
        root = Path(made, "root")
        add_program(root, wheel)
        add_system(root)
        add_control(root, version, architecture)
        run("chmod", "-R", "go=u,go-w", root)
        run("dpkg-deb", "--root-owner-group", "-Zzstd", "-z9", "--build", root, package, SOURCE_DATE_EPOCH=epoch())
    return package


def main() -> None:
    """Build the package of the wheel that the command line names, and print its file."""
    parser = argparse.ArgumentParser(description="Build the Debian 12 package of a wheel.")
    parser.add_argument("wheel", type=Path, help="wheel of CPython 3.11, of this machine's processor")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the package; default: dist")
    asked = parser.parse_args()
    package = build(asked.wheel.absolute(), asked.out)
    print(f"{package}  {package.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
