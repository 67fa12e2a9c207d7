"""How a system tells a program to go, and to stop for a while: the signals that Windows lacks, in one place.

`comms/guardian.py`, which imports nothing of ours, names its own.
"""

from __future__ import annotations

import signal

__all__ = ["SUSPENDED", "TERMINAL_GONE", "TOLD_TO_GO"]

#: the terminal was closed; Ctrl-Z: None where there is no such signal
TERMINAL_GONE: signal.Signals | None = getattr(signal, "SIGHUP", None)
SUSPENDED: signal.Signals | None = getattr(signal, "SIGTSTP", None)
#: all that means: end, and put everything in order
TOLD_TO_GO = tuple(number for number in (signal.SIGTERM, TERMINAL_GONE) if number is not None)
