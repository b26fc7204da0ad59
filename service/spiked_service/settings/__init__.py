"""Settings, their origins and their reload."""
