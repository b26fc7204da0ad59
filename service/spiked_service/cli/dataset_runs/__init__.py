"""Runs of `spiked datasets run`: recordings of a data set, one reconstruction each, scores, a table and a zip."""
