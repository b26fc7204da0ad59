"""Worker processes, their messages and their roles."""
