"""Standard streams as they may come: a terminal, a pipe, a file, or closed (`<&-`, cron, a service), where Python has None."""

from __future__ import annotations

import os
import sys
from typing import Literal

__all__ = ["has_terminal", "open_closed_streams"]

Stream = Literal["stdin", "stdout", "stderr"]


def has_terminal(*streams: Stream) -> bool:
    """Whether all of these are a terminal; by default stdin: somebody is there to be asked."""
    for name in streams or ("stdin",):
        stream = getattr(sys, name)
        if stream is None or stream.closed or not stream.isatty():
            return False
    return True


def open_closed_streams() -> None:
    """Have what came closed be empty: else the next file that is opened takes its number, and is read or written as it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  (until this process ends)
