"""What `spiked bench` measures across modules; each module's own figures come from its own benchmark."""
