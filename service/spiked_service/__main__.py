"""`python -m spiked_service` is the command `spiked`, which imports nothing from the current folder either."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the current folder, which `python -m` adds

from spiked_service.cli.program import main

main()
