"""How a system tells a program to go, and to stop for a while: the signals that Windows lacks, in one place.

`comms/guardian.py`, which imports nothing of ours, names its own.
"""

from __future__ import annotations

import signal

__all__ = ["SUSPENDED", "TERMINAL_GONE", "TOLD_TO_GO", "heard"]

#: the terminal was closed; Ctrl-Z: None where there is no such signal
TERMINAL_GONE: signal.Signals | None = getattr(signal, "SIGHUP", None)
SUSPENDED: signal.Signals | None = getattr(signal, "SIGTSTP", None)
#: all that means: end, and put everything in order
TOLD_TO_GO = tuple(number for number in (signal.SIGTERM, TERMINAL_GONE) if number is not None)


def heard(number: int) -> None:
    """In a handler of one of `TOLD_TO_GO`: what is said of a terminal that is gone is heard once.

    The kernel, the shell and who watches the terminal may all say so, and the kernel sends SIGCONT behind it, at which a program
    that draws would take hold of the terminal again.
    """
    if number == TERMINAL_GONE:
        signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGCONT, signal.SIG_DFL)
