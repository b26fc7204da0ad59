"""Images of keyframes in bounded memory."""

from collections.abc import Iterator, MutableMapping
from typing import Protocol

import numpy as np

from spiked.recon.frontend.feature_tracks import Picture

NEWEST_PICTURES = 64
"""Newest images that are always held: the tracker searches the points of these in each new keyframe."""


class PictureBuilder(Protocol):
    """Builds images of keyframes anew, by view id."""

    def holds(self, view_id: int) -> bool:
        """Whether the image can be built."""

    def build(self, view_id: int) -> Picture | None:
        """The image; None if it cannot be built."""


class KeyframePictures(MutableMapping[int, Picture]):
    """Images of keyframes by view id, in order of time.

    Of those beyond `most_bytes` the ones used least recently are built anew when they are asked for; where they cannot
    be, every second of the older keyframes is dropped.
    """

    def __init__(self, most_bytes: float = np.inf, builder: PictureBuilder | None = None) -> None:
        self._most_bytes = most_bytes
        self.builder = builder
        self._held: dict[int, Picture | None] = {}
        """None: to be built anew."""
        self._used: dict[int, None] = {}
        """Ids of the images in memory, those used last at the end."""
        self._bytes = 0

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: its owner sets the builder again."""
        return vars(self) | {"builder": None}

    def held(self) -> Iterator[Picture]:
        """The images in memory."""
        return (picture for picture in self._held.values() if picture is not None)

    @property
    def held_bytes(self) -> int:
        """Bytes of the images in memory."""
        return self._bytes

    def like(self) -> "KeyframePictures":
        """An empty store with the same limit and builder."""
        return KeyframePictures(self._most_bytes, self.builder)

    def take(self, other: "KeyframePictures") -> None:
        """Take over the images of another store, of later views."""
        for view_id, picture in other._held.items():
            if picture is None:
                self._held[view_id] = None
            else:
                self[view_id] = picture

    def __contains__(self, view_id: object) -> bool:
        return view_id in self._held

    def __len__(self) -> int:
        return len(self._held)

    def __iter__(self) -> Iterator[int]:
        return iter(self._held)

    def __getitem__(self, view_id: int) -> Picture:
        picture = self._held[view_id]
        if picture is None:
            picture = None if self.builder is None else self.builder.build(view_id)
            assert picture is not None, f"the image of view {view_id} was dropped"
            self._keep(view_id, picture)
        else:
            self._used[view_id] = self._used.pop(view_id)
        return picture

    def __setitem__(self, view_id: int, picture: Picture) -> None:
        if view_id in self._held:
            del self[view_id]
        self._keep(view_id, picture)

    def __delitem__(self, view_id: int) -> None:
        self._forget(view_id)
        del self._held[view_id]

    def _keep(self, view_id: int, picture: Picture) -> None:
        """Hold an image; others make room for it."""
        self._held[view_id] = picture
        self._used[view_id] = None
        self._bytes += picture.nbytes
        if self._bytes > self._most_bytes:
            self._make_room()

    def _make_room(self) -> None:
        """Forget images that can be built anew; otherwise drop every second of the older keyframes."""
        newest = set(list(self._held)[-NEWEST_PICTURES:])
        for other in [one for one in self._used if one not in newest]:
            if self.builder is None or self._bytes <= self._most_bytes:
                break
            if self.builder.holds(other):
                self._forget(other)
        if self._bytes > self._most_bytes:
            for other in list(self._held)[1:-NEWEST_PICTURES:2]:
                del self[other]

    def _forget(self, view_id: int) -> None:
        """Free the memory of an image."""
        picture = self._held[view_id]
        if picture is not None:
            self._held[view_id] = None
            self._bytes -= picture.nbytes
            del self._used[view_id]
