"""`python -m spiked_service` is the command `spiked`."""

from spiked_service.cli import main

main()
