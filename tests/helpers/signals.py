"""Processes that heed signals, also where the tests themselves are told to ignore some."""

import signal


def heed_signals() -> None:
    """In a new process, before its program starts: undo what `nohup` or a shell's & has set."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
