"""The measurements of `spiked bench` that span several modules."""
