"""Formats of other programs."""

from pydantic import Field

from spiked.errors import ConfigurationError
from spiked.export import ExportKind
from spiked_service.api.schemas.base import Out


class ExportFormatOut(Out):
    """A format that results are exported in."""

    name: str
    title: str = Field(description="What is written.")
    readers: str = Field(description="Programs that read it.")
    loses: str = Field(description="What of the reconstruction is not in it.")
    suffix: str = Field(description="Of the file that is sent.")
    missing: str = Field(description="How to install what the format needs; empty if nothing is missing.")

    @classmethod
    def of(cls, kind: ExportKind) -> "ExportFormatOut":
        """The format, with what is missing on this machine."""
        try:
            kind.check()
            missing = ""
        except ConfigurationError as error:
            missing = str(error)
        return cls(
            name=kind.name,
            title=kind.title,
            readers=kind.readers,
            loses=kind.loses,
            suffix=kind.suffix or ".zip",
            missing=missing,
        )


class ExportFormatsOut(Out):
    """All formats, in the order in which they are listed."""

    formats: list[ExportFormatOut]
