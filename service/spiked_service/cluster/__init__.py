"""Runs jobs on other machines: attempts with leases, files in an object store, engines that start agents."""
