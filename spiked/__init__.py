"""Spike-camera recordings in, camera trajectory and Gaussian scene out: the library, without hardware or network."""
