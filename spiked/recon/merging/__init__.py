"""One map of two: their frames of reference are brought together, splats are chosen, and both maps are rehearsed."""
