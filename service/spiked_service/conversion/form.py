"""Forms of files with frames."""

from enum import StrEnum


class Form(StrEnum):
    """How frames are stored in a file."""

    COMPACT = "compact"
    ROW_TAGGED = "row_tagged"
    USB = "usb"
    PCIE = "pcie"
    ARRAY = "array"
    """An array of NumPy or HDF5; read only."""
    BITS = "bits"
    """The bits of a frame one after the other, without an end of a row; read only."""


READ_ONLY = (Form.ARRAY, Form.BITS)
"""Forms that are not written."""


RECORDINGS = (Form.COMPACT, Form.ROW_TAGGED)
"""Forms that are recordings as they are."""
