"""Reports of results: one HTML file that needs nothing else, and a ZIP bundle with all that belongs to it."""
