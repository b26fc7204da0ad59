"""The figures of a localisation, as JSON."""

import numpy as np
from numpy.typing import NDArray

from spiked.recon import Localisation
from spiked.sensor import Sensor
from spiked_service.results.timeline import frames_at


def localisation_figures(found: Localisation, sensor: Sensor) -> dict[str, object]:
    """All figures of a localisation."""
    frames = frames_at(np.array([sensor.seconds(view.time) for view in found.views]), sensor.frame_rate_hz)
    views = [
        {
            "frame": int(frame),
            "time_s": sensor.seconds(view.time),
            "rotation": _rounded(view.pose.rotation),
            "position": _rounded(view.pose.centre),
            "inliers": view.fit.inliers,
            "inlier_share": round(view.fit.share, 4),
            "correlation": round(view.correlation, 4),
            "sigma": round(view.fit.sigma, 9),
            "sigma_px": round(view.fit.sigma_px, 4),
        }
        for frame, view in zip(frames, found.views, strict=True)
    ]
    return {
        "recognised": found.recognised,
        "reason": found.reason,
        "searches": found.searches,
        "agreeing": found.agreeing,
        "references": found.references,
        "best_inliers": found.best_inliers,
        "views": views,
    }


def _rounded(values: NDArray[np.float64]) -> list[object]:
    return list(np.round(values, 9).tolist())
