"""What an export format is."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

from spiked.errors import ConfigurationError
from spiked.export.source import ExportOptions, ExportSource
from spiked.sensor import Sensor
from spiked.whole_files import whole_file, whole_folder

__all__ = ["ExportKind"]


@dataclass(frozen=True)
class ExportKind:
    """A format that results are written in."""

    name: str
    """On the command line and in requests."""
    title: str
    """What is written, in a few words."""
    readers: str
    """Programs that read it."""
    loses: str
    """What of the reconstruction is not in it."""
    suffix: str
    """Of the file that is written, with its dot; empty for a folder."""
    fill: Callable[[ExportSource, Path, ExportOptions], str]
    """Writes the file, or fills an empty folder, and says in a few words what is in it.

    Raises SpikedError for a source that lacks what the format needs, and OSError. It need not clean up."""
    limit: Callable[[Sensor | None, ExportOptions], object] = lambda sensor, options: None
    """Raises ConfigurationError for options that ask for too much."""
    packages: tuple[str, ...] = ()
    """Modules that only this format needs."""
    extra: str = "export"
    """That installs them: `pip install 'spiked[EXTRA]'`."""
    media_type: str = "application/octet-stream"
    titled: bool = False
    """Whether the title of the source is in it."""
    replaces: tuple[str, ...] = ()
    """Patterns of the files of an earlier folder that a new one replaces; the folder may then hold no others."""
    stale: tuple[str, ...] = ()
    """Patterns of the files of an earlier folder that do not belong to a new one; others stay."""

    @property
    def folder(self) -> bool:
        """Whether it is a folder of files."""
        return not self.suffix

    @property
    def sent_as(self) -> str:
        """Media type over HTTP: of the file, or of the ZIP of a folder."""
        return "application/zip" if self.folder else self.media_type

    def write(self, source: ExportSource, path: Path, options: ExportOptions) -> str:
        """Write the file or folder whole or not at all, and say in a few words what is in it.

        A folder that exists keeps its other files. After an error an earlier file or folder is as it was.
        Raises SpikedError for a source that lacks what the format needs, SceneError for a folder that holds files of
        something else, and OSError.
        """
        with whole_folder(path, self.replaces, self.stale) if self.folder else whole_file(path) as part:
            return self.fill(source, part, options)

    def check(self) -> None:
        """Raises ConfigurationError if one of `packages` is not installed."""
        for package in self.packages:
            optional(package, self.extra)


def optional(module: str, extra: str = "export") -> ModuleType:
    """A module of an extra. Raises ConfigurationError if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ConfigurationError(
            f"this format needs the Python package of {module.split('.', maxsplit=1)[0]}: pip install 'spiked[{extra}]'"
        ) from error
