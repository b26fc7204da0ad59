"""From views and poses to splats."""
