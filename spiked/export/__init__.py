"""Results in the formats of other programs: `KINDS` lists them, `find_kind(name).write(...)` writes one."""

from spiked.export.kind import ExportKind
from spiked.export.registry import KINDS, find_kind
from spiked.export.source import ExportOptions, ExportSource

__all__ = ["KINDS", "ExportKind", "ExportOptions", "ExportSource", "find_kind"]
