"""What everything else of the service stands on."""
