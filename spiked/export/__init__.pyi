from .kind import ExportKind
from .registry import KINDS, find_kind
from .source import ExportOptions, ExportSource

__all__ = ["KINDS", "ExportKind", "ExportOptions", "ExportSource", "find_kind"]
