"""Which paths are long: adjusted by keyframes and interpolated between views, shorter ones as a whole on a spline."""

LONG_FRAMES, LONG_VIEWS = 12_000, 1000
"""Frames or views with a pose from which on a path is long (decision 15)."""
