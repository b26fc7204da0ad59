"""Errors of the service that callers tell apart; what is unknown is `store.catalogue.UnknownIdError`."""

from spiked.errors import SpikedError


class BusyError(SpikedError):
    """It cannot be done now, because something else is going on."""
