"""Results: published versions, timelines, rendered views and images of frames."""
