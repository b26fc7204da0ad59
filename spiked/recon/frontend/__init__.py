"""From spikes to tracks: windows of frames, rates, features."""
