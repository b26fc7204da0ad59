"""The version of the installed distribution."""

from importlib import metadata


def installed_version() -> str:
    """The version of the installed distribution, or `unknown` when spiked runs from an uninstalled tree."""
    try:
        return metadata.version("spiked")
    except metadata.PackageNotFoundError:
        return "unknown"
