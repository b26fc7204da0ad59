"""Quality of a finished path: of each view, and of the path as a whole."""

from spiked.recon.odometry.pnp import fit_pose
from spiked.recon.odometry.self_calibration import MAX_FOCAL_SIGMA, MAX_LENS_SIGMA_PX
from spiked.recon.odometry.sparse_map import SparseMap
from spiked.recon.odometry.tracking_state import State, TrackingState

WORST_PATH_ERROR = 0.03
"""Predicted path error, relative to the path's RMS radius, above which the path is degraded and a warning is given
(decision 7)."""
FINAL_STATE_VIEWS = 8
"""The final state is that of most of the last 8 views: one noisy view does not decide it (decision 10)."""


def assess(sparse_map: SparseMap, status: TrackingState, path_error: float | None, rough: bool) -> None:
    """Recompute inliers, chi2 and state of every view with the final path and points; set the final state.

    `path_error`: predicted error of the path relative to its RMS radius, if it is known. `rough`: see `Initialiser`.
    """
    assessed: list[str | None] = []
    for view in sparse_map.views:
        if view.pose is None:
            continue
        fit = fit_pose(sparse_map, view, view.pose, move=False)
        reason = fit.degraded_reason(len(view.ids))
        fit.store_quality(view)
        if view.state in (State.TRACK, State.DEGRADED):
            view.state = State.TRACK if reason is None else State.DEGRADED
        assessed.append(reason)
    if assessed and status.state in (State.TRACK, State.DEGRADED):
        last = assessed[-FINAL_STATE_VIEWS:]
        reasons = [reason for reason in last if reason is not None]
        common = reasons[-1] if len(reasons) > len(last) - len(reasons) else None
        status.assess(sparse_map.views[-1].time, common)
        if why := _path_degraded_reasons(sparse_map, path_error, rough):
            status.set(sparse_map.views[-1].time, State.DEGRADED, "; ".join(why))


def _path_degraded_reasons(sparse_map: SparseMap, path_error: float | None, rough: bool) -> list[str]:
    """Why the final path is degraded as a whole, however well each view fits."""
    why = ["the camera moved sideways so little that depths are rough"] if rough else []
    if path_error is not None and path_error > WORST_PATH_ERROR:
        why.append(f"the whole path's shape is only known to about {path_error:.0%}: few tracks tie it together")
    focal, lens = sparse_map.focal, sparse_map.lens
    if focal is not None and focal.relative_sigma > MAX_FOCAL_SIGMA:
        sigma = focal.relative_sigma
        known = "that the recording does not determine" if sigma > 1 else f"only known to about {sigma:.0%}"
        why.append(f"path and depths depend on a focal length {known}")
    if lens is not None and lens.corner_sigma_px > MAX_LENS_SIGMA_PX:
        why.append(f"the distortion of the lens is only known to about {lens.corner_sigma_px:.0f} px")
    return why
