"""The daemon and the command line: the one place that creates processes and reads configuration."""
