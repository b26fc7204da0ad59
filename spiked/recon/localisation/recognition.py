"""When a recording counts as recognised in a map."""

from dataclasses import dataclass

from spiked.errors import RecordingError
from spiked.recon.localisation.search import LEAST_MATCHES, Candidate, Search, same_place
from spiked.recon.odometry.sparse_map import Pose

LEAST_INLIERS = 30
"""Points of the map that agree with the pose of a view. Foreign places have up to 20, true ones 91 and more (decision
16, as the next two)."""
LEAST_SHARE = 0.3
"""Share of the points of the map in view that agree with the pose. Wrong places have up to 0.17, views of a walk in its
map 0.66 and more."""
LEAST_CORRELATION = 0.5
"""Correlation of details of the view and of the map rendered there. Wrong places have up to 0.36, true ones 0.75 and
more."""
RIVAL = 0.6
"""Score of another place over that of the best one, from which on the two cannot be told apart. The best wrong place
of a walk's map has 0.05, a copy of the true place has 1."""
LEAST_AGREEING = 2
"""Searches, in different views, that have to find the same path."""


@dataclass
class Recognition:
    """Counts what the searches of a recording found."""

    references: int
    """Reference views of the map."""
    searches: int = 0
    agreeing: int = 0
    """Searches that found the path, or began it."""
    contradicting: int = 0
    """Searches that clearly found another place than the path has."""
    ambiguous: int = 0
    """Searches that found several places that look alike."""
    most_features: int = 0
    best: Candidate | None = None
    """The candidate with the most points that agree."""

    def judge(self, found: Search, path: Pose | None) -> Candidate | None:
        """Count a search in a view that has the pose `path`, if any; the place that the view shows beyond doubt."""
        self.searches += 1
        self.most_features = max(self.most_features, found.features)
        for one in found.candidates:
            if self.best is None or one.fit.inliers > self.best.fit.inliers:
                self.best = one
        if not found.candidates or not accepted(found.candidates[0]):
            return None
        best, *others = found.candidates
        if any(one.score > RIVAL * best.score for one in others):
            self.ambiguous += 1
            return None
        if path is None or same_place(best.anchor, path):
            self.agreeing += 1
        else:
            self.contradicting += 1
        return best

    @property
    def decided(self) -> bool:
        """Enough searches agree."""
        return self.agreeing >= LEAST_AGREEING and self.agreeing > 2 * self.contradicting

    def check_texture(self) -> None:
        """Raises RecordingError if no view had enough texture to be searched for."""
        if self.most_features < LEAST_MATCHES:
            raise RecordingError(
                f"the recording shows too little texture or light to be recognised: {self.most_features} features in "
                f"its best view, {LEAST_MATCHES} needed"
            )

    def reason(self) -> str:
        """Why the recording is recognised or not, in one sentence."""
        if self.decided:
            return f"recognised: {self.agreeing} of {self.searches} searches agree"
        if self.agreeing + self.contradicting == 0 and self.ambiguous:
            return "not recognised: several places of the map look like the recording"
        if self.agreeing:
            return f"not recognised: {self.agreeing} of {self.searches} searches agree, {LEAST_AGREEING} needed" + (
                f" and at most half as many elsewhere, {self.contradicting} found" if self.contradicting else ""
            )
        return f"not recognised: {self._shortfall()}"

    def _shortfall(self) -> str:
        if self.best is None:
            return f"none of {self.references} reference views matches"
        fit = self.best.fit
        found = f"best of {self.references} reference views agrees in {fit.inliers} points"
        if fit.inliers < LEAST_INLIERS:
            return f"{found}, {LEAST_INLIERS} needed"
        if fit.share < LEAST_SHARE:
            return f"{found}, {fit.share:.0%} of those in view, {LEAST_SHARE:.0%} needed"
        likeness = f"correlation {self.best.correlation:.2f}, {LEAST_CORRELATION} needed"
        return f"{found}, but the map looks different there: {likeness}"


def accepted(candidate: Candidate) -> bool:
    """Whether an image shows this place."""
    fit = candidate.fit
    return fit.inliers >= LEAST_INLIERS and fit.share >= LEAST_SHARE and candidate.correlation >= LEAST_CORRELATION
