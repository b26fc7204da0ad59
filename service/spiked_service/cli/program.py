"""The program `spiked` from its first moment, at which it imports nothing else yet."""

import signal


def main() -> None:
    """Run `spiked` with the arguments of this process. Ctrl-C during the imports ends it without a traceback."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not where the shell has Ctrl-C ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from spiked_service.cli.main import main as run

    signal.signal(signal.SIGINT, before)
    run()
