"""The commands of `spiked`, one a file; `cli` puts them together."""
