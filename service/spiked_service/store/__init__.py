"""What the service keeps: files in one data folder, and a catalogue of what they are."""
