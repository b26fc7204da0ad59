"""Engines that start agents; each module is imported in the process of the engine only."""
