"""What workers do: one module a role, with a function `run_ROLE`."""
