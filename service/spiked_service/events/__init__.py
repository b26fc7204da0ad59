"""The event bus, its messages, and the log."""
