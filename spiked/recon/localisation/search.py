"""Global search: the places of a map that an image may show."""

from dataclasses import dataclass

import numpy as np

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import LEVELS, Picture, Pyramid, pyramid
from spiked.recon.frontend.features import Features, find_features, match
from spiked.recon.localisation.alignment import Anchor, Fit, align, correlation
from spiked.recon.localisation.map_index import MapIndex
from spiked.recon.odometry.pnp import draw_pose
from spiked.recon.odometry.sparse_map import Pose

QUERY_FEATURES = 500
"""Features of a query, at most."""
NEAREST, SPREAD = 3, 5
"""References tried: those of the most votes, and the best of so many other places."""
OTHER_PLACE_PX = 150.0
"""Image shift from one place to another, in px."""
LEAST_MATCHES = 10
"""Matches with a reference from which a pose is drawn."""
SAME_PX = 8.0
"""Two poses are the same if they shift the image by less."""


@dataclass(frozen=True)
class Candidate:
    """A place of the map that an image may show."""

    reference: int
    fit: Fit
    anchor: Anchor
    correlation: float

    @property
    def score(self) -> float:
        """Which of two places an image shows rather."""
        return self.fit.inliers * max(self.correlation, 0.0)


@dataclass(frozen=True)
class Search:
    """What a search for an image found."""

    candidates: list[Candidate]
    """Different places, the best first."""
    features: int
    """Features of the image."""


def search(index: MapIndex, image: Picture, aligned: int = 3) -> Search:
    """The places of a map that an image [H, W] may show; the `aligned` most promising ones are compared in detail."""
    features = find_features(image, QUERY_FEATURES)
    if len(features) < LEAST_MATCHES:
        return Search([], len(features))
    numbers = _promising(index, index.votes(features))
    drawn = [(number, *found) for number in numbers if (found := _draw(index, features, number)) is not None]
    drawn.sort(key=lambda one: -one[2])
    levels = pyramid(image, LEVELS)
    out: list[Candidate] = []
    tried: list[Pose] = []
    for number, pose, _ in drawn:
        if len(tried) == aligned:
            break
        if any(same_place(one.anchor, pose) for one in out):
            continue
        tried.append(pose)
        place = candidate_at(index, image, levels, number, pose)
        if place is not None and not any(same_place(one.anchor, place.fit.pose) for one in out):
            out.append(place)
    out.sort(key=lambda one: -one.score)
    return Search(out, len(features))


def candidate_at(index: MapIndex, image: Picture, levels: Pyramid, number: int, pose: Pose) -> Candidate | None:
    """The place near a pose, found from reference `number`, that an image may show; None if it is lost on the way."""
    found = align(index.renderer, levels, pose)
    if found is None:
        return None
    fit, anchor = found
    return Candidate(number, fit, anchor, correlation(anchor.view, image))


def same_place(anchor: Anchor, pose: Pose) -> bool:
    """Whether a camera at a pose sees the same image as a render, but for a few pixels."""
    return anchor.shift_px(pose) < SAME_PX


def _promising(index: MapIndex, votes: Array) -> list[int]:
    """References to compare with a query: those of the most votes, and the best ones of other places."""
    order = np.argsort(-votes, kind="stable").tolist()
    chosen = order[:NEAREST]
    places = chosen[:1]
    for number in order[1:]:
        if len(places) > SPREAD:
            break
        shifts = index.shifts_px(index.references[number].pose)
        if (shifts[places] > OTHER_PLACE_PX).all():
            places.append(number)
    return list(dict.fromkeys([*chosen, *places]))


def _draw(index: MapIndex, features: Features, number: int) -> tuple[Pose, int] | None:
    """The pose that most matches of a reference agree with, by three points at a time (AP3P), and how many do."""
    reference = index.references[number]
    rows, columns = match(features, reference.features)
    if len(rows) < LEAST_MATCHES:
        return None
    return draw_pose(reference.points[columns], features.pixels[rows], index.camera.intrinsics)
