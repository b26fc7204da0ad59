"""Camera sources: replayed recordings, the simulated camera, and USB hardware, all behind one `Source` protocol."""
