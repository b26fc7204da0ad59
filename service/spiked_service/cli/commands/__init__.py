"""The commands of `spiked`, one per file; `cli.main` registers them."""
