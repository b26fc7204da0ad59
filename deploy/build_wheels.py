"""Builds the wheels of a release: CPython 3.11, and the stable ABI of 3.12 and later, for glibc 2.28 (manylinux_2_28).

The compiler is Clang of the package ziglang, which brings the C library of each target. It links against glibc 2.28 on
any machine and compiles for aarch64 on x86-64. Tools come from PyPI by number (wheels/tools.txt). With
SOURCE_DATE_EPOCH, by default the time of the last commit, the same sources give the same bytes, in whatever folder they
lie. nvcc takes no Clang with libc++: the module of the CUDA kernels is compiled by GCC, on x86-64, and linked by that
Clang against the same glibc. docs/packages.md has the figures.

    make wheels
    python deploy/build_wheels.py --python python3.12 --machine aarch64
"""

import argparse
import os
import platform
import shutil
import sys
import tempfile
from pathlib import Path

from building import DEPLOY, ROOT, epoch, run

TOOLS = DEPLOY / "wheels" / "tools.txt"
GLIBC = "2.28"
"""manylinux_2_28: Debian 10, Ubuntu 18.10, RHEL 8 and all after them."""
MACHINES = ("x86_64", "aarch64")
PYTHONS = ("python3.11", "python3.12")
KERNELS = Path(tempfile.gettempdir()) / "spiked-kernels"
"""Where the module of the CUDA kernels is compiled: nvcc's names of symbols depend on the folder."""
MOST_BYTES = 30_000_000
"""Size of a wheel that stops the build."""


def tools(python: str, folder: Path) -> Path:
    """The folder of programs of an environment with this interpreter and the tools, which is made if it is missing."""
    found = shutil.which(python)
    if found is None:
        sys.exit(f"error: there is no {python}; install it, or name others with --python")
    wanted = TOOLS.read_text()
    stamp = folder / "tools.txt"
    if not stamp.is_file() or stamp.read_text() != wanted:
        run(found, "-m", "venv", "--clear", folder)
        run(folder / "bin/pip", "install", "--quiet", "-r", TOOLS)
        stamp.write_text(wanted)
    return folder / "bin"


def compilers(programs: Path, machine: str, folder: Path) -> dict[str, str]:
    """Environment variables that name the compilers of a target."""
    folder.mkdir(parents=True, exist_ok=True)
    # nanobind leaves it to other headers to include <cstdio>, which libc++'s do not.
    extra = {"c++": " -include cstdio -Wno-macro-redefined"}
    for name, tool in {"cc": "cc", "c++": "c++", "ar": "ar", "ranlib": "ranlib"}.items():
        target = f" -target {machine}-linux-gnu.{GLIBC} -g0" if tool in ("cc", "c++") else ""
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec "{programs}/python" -m ziglang {tool}{target}{extra.get(tool, "")} "$@"\n')
        script.chmod(0o755)
    return {"CC": f"{folder}/cc", "CXX": f"{folder}/c++"}


def target_settings(programs: Path, machine: str, folder: Path) -> tuple[dict[str, str], list[str]]:
    """Environment variables, and definitions of CMake, of a build for a machine."""
    variables = {"_PYTHON_HOST_PLATFORM": f"linux-{machine}"}
    defines = [f"CMAKE_AR={folder}/ar", f"CMAKE_RANLIB={folder}/ranlib"]
    defines += ["CMAKE_SYSTEM_NAME=Linux", f"CMAKE_SYSTEM_PROCESSOR={machine}"]
    suffix = run(programs / "python", "-c", "import sysconfig; print(sysconfig.get_config_var('EXT_SUFFIX'))").strip()
    variables["SETUPTOOLS_EXT_SUFFIX"] = f"{suffix.split('-')[0]}-{suffix.split('-')[1]}-{machine}-linux-gnu.so"
    return variables, defines


def gpu_module(programs: Path, scripts: Path, path: str) -> Path:
    """The module with the CUDA kernels for the tools' Python, on x86-64; `path` is that of programs."""
    if shutil.which("g++") is None:
        sys.exit("error: nvcc needs g++; install it")
    shutil.rmtree(KERNELS, ignore_errors=True)
    source, tree = KERNELS / "source", KERNELS / "build"
    shutil.copytree(ROOT / "spiked/native", source / "spiked/native", ignore=shutil.ignore_patterns("*.so"))
    shutil.copy(ROOT / "CMakeLists.txt", source)
    # libgcc_s is the target's: the unwinder of this machine's static one needs its glibc.
    standard, unwinder = (run("g++", f"-print-file-name={name}").strip() for name in ("libstdc++.a", "libgcc_s.so.1"))
    extra = f"-Wl,--version-script={DEPLOY}/wheels/exports.map {DEPLOY}/wheels/single_threaded.c"
    link = f"{scripts}/cc -shared -s -Wl,--gc-sections {extra} -o <TARGET> <OBJECTS> <LINK_LIBRARIES>"
    stable = run(programs / "python", "-c", "import sys; print(int(sys.version_info >= (3, 12)))").strip() == "1"
    defines = [f"Python_EXECUTABLE={programs}/python", "CMAKE_CXX_COMPILER=g++", "SKBUILD_STATE=wheel"]
    defines += [f"CMAKE_CXX_CREATE_SHARED_MODULE={link} {standard} {unwinder} -lm"]
    defines += ["SKBUILD_SABI_COMPONENT=Development.SABIModule"] if stable else []
    run(programs / "cmake", "-S", source, "-B", tree, "-G", "Ninja", *(f"-D{define}" for define in defines), PATH=path)
    run(programs / "cmake", "--build", tree, "--target", "_gpu", PATH=path)
    if not (tree / "spiked/native/gpu/cuda.o").is_file():
        sys.exit("error: the kernels were not compiled; CMake's warning above says why")
    (module,) = (tree / "spiked/native/gpu").glob("_gpu*.so")
    check_symbols(programs, module)
    return module


def check_symbols(programs: Path, module: Path) -> None:
    """End the program if the module needs a symbol that neither Python nor a library of the target has."""
    script = (
        "import sys; from elftools.elf.elffile import ELFFile as E; e = E(open(sys.argv[1], 'rb'));"
        "v = e.get_section_by_name('.gnu.version');"
        "print(*(s.name for i, s in enumerate(e.get_section_by_name('.dynsym').iter_symbols()) if s.name"
        " and s['st_shndx'] == 'SHN_UNDEF' and s['st_info']['bind'] == 'STB_GLOBAL'"
        " and v.get_symbol(i)['ndx'] in ('VER_NDX_LOCAL', 'VER_NDX_GLOBAL')))"
    )
    needed = run(programs / "python", "-c", script, module).split()
    unknown = [name for name in needed if not name.startswith(("Py", "_Py"))]
    if unknown:
        sys.exit(f"error: {module.name} needs {', '.join(unknown)}, which glibc {GLIBC} lacks")


def build(python: str, machine: str, out: Path) -> Path:
    """One wheel, checked, in the folder `out`."""
    work = ROOT / "build" / "wheels"
    programs = tools(python, work / f"tools-{Path(python).name}")
    scripts = work / f"compilers-{machine}"
    variables, defines = target_settings(programs, machine, scripts)
    variables |= compilers(programs, machine, scripts)
    variables |= {"SOURCE_DATE_EPOCH": epoch(), "LC_ALL": "C.UTF-8"}
    variables |= {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    if machine == "x86_64" == platform.machine():
        defines += [f"SPIKED_GPU_MODULE={gpu_module(programs, scripts, variables['PATH'])}"]
    tree = work / f"{Path(python).name}-{machine}"
    with tempfile.TemporaryDirectory() as made:
        run(
            programs / "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--wheel-dir", made,
            f"--config-settings=build-dir={tree}",
            *(f"--config-settings=cmake.define.{define}" for define in defines),
            ROOT, **variables,
        )  # fmt: skip
        (plain,) = Path(made).glob("*.whl")
        repaired = Path(made, "repaired")
        # auditwheel takes names of this machine's processor only; of another it finds out itself which one fits.
        own = machine == platform.machine()
        tag = f"manylinux_{GLIBC.replace('.', '_')}_{machine}" if own else "auto"
        run(programs / "auditwheel", "repair", "--only-plat", "--plat", tag, "-w", repaired, plain, **variables)
        (wheel,) = repaired.glob("*.whl")
        check(programs, wheel)
        out.mkdir(parents=True, exist_ok=True)
        shutil.copy(wheel, out / wheel.name)
    shutil.rmtree(KERNELS, ignore_errors=True)
    return out / wheel.name


def check(programs: Path, wheel: Path) -> None:
    """End the program if the wheel uses what its name does not promise, is too large or lacks page or documentation."""
    if "-abi3-" in wheel.name:
        run(programs / "abi3audit", "--strict", wheel)
    if wheel.stat().st_size > MOST_BYTES:
        sys.exit(f"error: {wheel.name} has {wheel.stat().st_size / 1e6:.1f} MB, more than {MOST_BYTES / 1e6:.0f}")
    inside = run(sys.executable, "-m", "zipfile", "--list", wheel)
    for folder, target in {"page": "page", "guide": "docs"}.items():
        if f"spiked_service/{folder}/index.html" not in inside:
            sys.exit(f"error: {wheel.name} has no {folder}; run `make {target}` first")
    if "spiked/export/viewer.js" not in inside:
        sys.exit(f"error: {wheel.name} has no viewer; run `make page` first")


def main() -> None:
    """Build what the command line asks for, and print the files."""
    parser = argparse.ArgumentParser(description="Build the wheels of a release into a folder.")
    parser.add_argument("--python", action="append", help=f"interpreter; default: {' and '.join(PYTHONS)}")
    parser.add_argument("--machine", action="append", choices=MACHINES, help="processor; default: both")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the wheels; default: dist")
    asked = parser.parse_args()
    for python in asked.python or PYTHONS:
        for machine in asked.machine or MACHINES:
            wheel = build(python, machine, asked.out)
            print(f"{wheel}  {wheel.stat().st_size / 1e6:.1f} MB", flush=True)


if __name__ == "__main__":
    main()
