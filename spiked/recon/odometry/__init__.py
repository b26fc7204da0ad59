"""From tracks to the camera's path."""
