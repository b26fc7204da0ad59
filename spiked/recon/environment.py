"""What the results of a reconstruction depend on besides its input: versions of the program, and the machine."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version

from spiked.measurement import processor
from spiked.render.cpu import usable_cores

LIBRARIES = "numpy", "opencv-python-headless"
"""Packages whose versions are reported: results depend on them."""


def versions() -> dict[str, str]:
    """Versions of the program, Python, and the libraries that results depend on."""
    try:
        release = version("spiked")
    except PackageNotFoundError:
        release = "unknown"
    return {"spiked": release, "python": platform.python_version()} | {name: version(name) for name in LIBRARIES}


def machine() -> dict[str, object]:
    """The machine that runs this: processor, cores that may be used, bytes of memory, system."""
    pages, page_bytes = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    return {
        "processor": processor(),
        "cores": usable_cores(),
        "memory_bytes": pages * page_bytes,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }
