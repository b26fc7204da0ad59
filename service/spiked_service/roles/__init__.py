"""What the workers do: acquisition, reconstruction, preview, each in a process of its own."""
