"""What ends a command from outside: being told to go, Ctrl-Z, a terminal that is gone. A robot's motion ends first, always."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from types import FrameType

import click

from openant_tools.cli.streams import has_terminal
from openant_tools.signals import SUSPENDED, TERMINAL_GONE, TOLD_TO_GO, heard

__all__ = ["MOVES", "end_with_the_terminal", "heed_signals"]

#: in a click context's meta: the command has the builder's word that it may move
MOVES = "openant moves"
#: s in which a command that was interrupted has laid its robot down
ENDED_S = 10.0


def heed_signals() -> None:
    """Being told to go, and a terminal that is closed, are as good as Ctrl-C: torque goes off, what was learned is saved."""
    for number in TOLD_TO_GO:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, _interrupt)
    if SUSPENDED is not None and signal.getsignal(SUSPENDED) is not signal.SIG_IGN:
        signal.signal(SUSPENDED, _suspend)


def end_with_the_terminal() -> None:
    """From now on be interrupted where the terminal goes, or whoever reads what this program says: ssh tells nobody.

    Under nohup, which ignores that, the program goes on.
    """
    gone = TERMINAL_GONE
    if gone is None or signal.getsignal(gone) is signal.SIG_IGN:
        return
    poll = select.poll()
    for fd in (0, 1, 2):
        if fd > 0 or has_terminal():  # an input that ends is no terminal that is gone
            poll.register(fd, 0)

    def wait() -> None:
        while found := poll.poll():
            if any(what & (select.POLLERR | select.POLLHUP) for _, what in found):
                os.kill(os.getpid(), gone)
                # An interrupt can be lost, in a destructor or to whoever catches everything; and nobody is there to give another.
                time.sleep(ENDED_S)
                _release()
                return
            for fd, _ in found:  # it was closed from the beginning
                poll.unregister(fd)

    threading.Thread(target=wait, name="terminal", daemon=True).start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    heard(number)
    raise KeyboardInterrupt


def _suspend(number: int, frame: FrameType | None) -> None:
    """Torque off, then stop as Ctrl-Z wants it. What comes back does not go on moving: it ends as after Ctrl-C."""
    context = click.get_current_context(silent=True)
    moves = context is not None and bool(context.meta.get(MOVES))
    moves = _release() or moves
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    signal.signal(number, _suspend)
    if moves:
        raise KeyboardInterrupt


def _release() -> bool:
    """Torque off at everything that this process has open; whether an engine in it moves something."""
    if "openant_tools.comms.engine_process" not in sys.modules:
        return False
    from openant_tools.comms.engine_process import EngineProcess
    from openant_tools.comms.release import release_all

    moves = any(not engine.config.still for engine in EngineProcess.running)
    release_all()
    return moves
