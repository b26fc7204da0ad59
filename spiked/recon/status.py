"""What a reconstruction tells while it runs: its status, its tracked views, and pictures of them."""

from dataclasses import dataclass

from spiked.pose import Array
from spiked.recon.odometry.tracking_state import State
from spiked.sensor import Image


@dataclass(frozen=True)
class Status:
    """Progress and state of a reconstruction."""

    state: State
    reason: str
    stage: str
    """waiting, tracking, mapping, refining or done."""
    frames: int
    splats: int
    loss: float | None
    """Mean squared error of the views in units of white squared, weighted by the noise."""
    version: int
    """Increases when the scene or the trajectory changes."""
    progress: float
    """Share of the final refinement done, 0 to 1."""
    inliers: float | None = None
    """Of the newest pose, as are the next two: share of the known points that agree with it."""
    chi2: float | None = None
    """Squared median residual over the expected one; 1 if the noise explains it."""
    sigma_px: float | None = None
    """Predicted error, as a displacement of the image at the median depth."""
    left_s: float | None = None
    """Predicted seconds to the end of `Reconstructor.finish`; None while it is not known how many frames will come."""


@dataclass(frozen=True)
class Tracked:
    """Tracking result of one view."""

    time: float
    """Middle of the view in frames."""
    time_s: float
    state: State
    rotation: Array | None
    """Camera to world, [3, 3]; None before the bootstrap and while lost."""
    centre: Array | None
    """[3], in the trajectory's unit."""
    rate: float
    """Mean spikes a pixel and frame."""
    sigma_px: float | None = None
    """Standard deviation of the pose in the image, if known."""
    chi2: float | None = None
    """Squared median residual over the expected one, if known."""


@dataclass(frozen=True)
class Sample:
    """Observed and rendered image [H, W, C] of one view, radiance, for visual comparison."""

    time_s: float
    observed: Image
    rendered: Image | None
    """None without a map."""
