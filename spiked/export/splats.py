"""The splats themselves, in the files of viewers and editors."""

from collections.abc import Callable
from pathlib import Path

from spiked import spz
from spiked.export import compressed_ply, sog
from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.scene import Scene

__all__ = ["COMPRESSED_PLY", "PLY", "SOG", "SPZ"]


def _writer(
    encode: Callable[[Scene, ExportSource], bytes], *, harmonics: bool = True
) -> Callable[[ExportSource, Path, ExportOptions], str]:
    """What writes a scene as `encode` has it, and says if it leaves harmonics out."""

    def fill(source: ExportSource, path: Path, options: ExportOptions) -> str:
        scene = source.need_scene()
        path.write_bytes(encode(scene, source))
        if scene.harmonics is None:
            return f"{len(scene)} splats"
        degree = f"view-dependent colour of degree {scene.degree}"
        return f"{len(scene)} splats, {degree if harmonics else f'without their {degree}: use ply or spz to keep it'}"

    return fill


PLY = ExportKind(
    name="ply",
    title="splats: 3DGS PLY",
    readers="all viewers and trainers of splats",
    loses="nothing",
    suffix=".ply",
    fill=_writer(lambda scene, source: scene.ply(notes=source.scale.notes)),  # the scene's own white is noted in it
)
COMPRESSED_PLY = ExportKind(
    name="compressed-ply",
    title="splats: compressed PLY of PlayCanvas, 16 bytes a splat",
    readers="SuperSplat, PlayCanvas, Spark, splat-transform",
    loses="rounding: 1/2048 of a group of 256 splats; the radiance of white",
    suffix=".compressed.ply",
    fill=_writer(lambda scene, source: compressed_ply.encode(scene, source.white, source.scale.notes)),
)
SPZ = ExportKind(
    name="spz",
    title="splats: SPZ of Niantic",
    readers="Scaniverse, Spark, Babylon.js, Cesium",
    loses="rounding (spiked/spz.py has the bounds); the radiance of white",
    suffix=".spz",
    fill=_writer(lambda scene, source: spz.encode(scene, source.white)),
)
SOG = ExportKind(
    name="sog",
    title="splats: SOG of PlayCanvas, in one file",
    readers="SuperSplat, PlayCanvas, Spark, splat-transform",
    loses="rounding: 256 values of scale and of colour; the radiance of white; view-dependent colour",
    suffix=".sog",
    fill=_writer(lambda scene, source: sog.encode(scene, source.white, source.scale.known), harmonics=False),
)
