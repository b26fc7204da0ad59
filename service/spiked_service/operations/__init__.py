"""What whoever runs the service watches: metrics, doctor, systemd."""
