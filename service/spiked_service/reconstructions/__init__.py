"""The queue of reconstructions."""
