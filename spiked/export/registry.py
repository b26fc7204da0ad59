"""All export formats. A new one: its module and a line here."""

from spiked.errors import ConfigurationError
from spiked.export import (
    colmap,
    depth_maps,
    mcap_log,
    mesh,
    nerfstudio,
    nexus,
    point_cloud,
    rerun_log,
    ros_bag,
    splats,
    video,
    viewer_page,
)
from spiked.export.kind import ExportKind

KINDS: tuple[ExportKind, ...] = (
    depth_maps.KIND,
    point_cloud.PLY,
    point_cloud.PCD,
    mesh.PLY,
    mesh.GLB,
    colmap.KIND,
    nerfstudio.KIND,
    splats.PLY,
    splats.COMPRESSED_PLY,
    splats.SPZ,
    splats.SOG,
    rerun_log.KIND,
    mcap_log.KIND,
    ros_bag.KIND,
    nexus.KIND,
    video.KIND,
    viewer_page.KIND,
)
"""In the order in which they are listed."""


def find_kind(name: str) -> ExportKind:
    """The format of this name. Raises ConfigurationError."""
    for kind in KINDS:
        if kind.name == name:
            return kind
    raise ConfigurationError(f"{name!r} is none of {', '.join(kind.name for kind in KINDS)}")
