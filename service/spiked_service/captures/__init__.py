"""Captures: live ones, uploads, devices, and the data folder."""
