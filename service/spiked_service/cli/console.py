"""Where the command line writes: results on standard output, progress and errors on standard error."""

from rich.console import Console

output = Console(soft_wrap=True, highlight=False)
messages = Console(stderr=True, soft_wrap=True, highlight=False)


def report_error(error: Exception) -> None:
    """One line, whatever the message holds."""
    messages.print(f"error: {' '.join(str(error).split())}", markup=False, style="red")


def report_warning(sentence: str) -> None:
    """One line that begins with `warning:`."""
    messages.print(f"warning: {sentence}", markup=False, style="yellow")
