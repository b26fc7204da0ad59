"""Maps that commands begin from."""

from pathlib import Path

from spiked_service.cli.console import report_warning
from spiked_service.results.map_folder import MapFolder


def read_map(folder: Path) -> MapFolder:
    """The map in a folder; one that was not made to its end is warned about. Raises SceneError."""
    found = MapFolder.read(folder)
    if found.outcome != "complete":
        report_warning(f"{folder} holds a map that is not complete: its run was {found.outcome}")
    return found
