"""Conversion between recordings, raw camera bytes and arrays of spikes."""
