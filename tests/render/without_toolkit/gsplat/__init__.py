"""A gsplat whose kernels could not be compiled: it imports, and fails when it is to render, as the real one does."""

from typing import Any

_C: Any = None


def rasterization(*args: Any, **options: Any) -> Any:
    """Ask the kernels, which are not there."""
    return _C.projection_ewa_3dgs_fused_fwd(*args, **options)
