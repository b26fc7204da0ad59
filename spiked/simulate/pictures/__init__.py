"""Spikes from pictures: a video, or a folder of images with their times, seen by the simulated sensor."""
