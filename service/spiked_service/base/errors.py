"""Errors of the service; for unknown ids see `store.catalogue.UnknownIdError`."""

from spiked.errors import SpikedError


class BusyError(SpikedError):
    """The operation conflicts with one that is running; try again later."""
