"""The program in a terminal that goes, and told to go: it ends in order, whatever it was drawing."""

from __future__ import annotations

import os
import pty
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

fcntl, termios = pytest.importorskip("fcntl"), pytest.importorskip("termios")
#: by which the program says that it was interrupted
INTERRUPTED = 130
#: s, of a loaded machine
PATIENCE_S = 60.0


def the_terminal_goes(pid: int, terminal: int) -> None:
    os.close(terminal)  # the kernel sends SIGHUP, and SIGCONT behind it


def told_to_go(pid: int, terminal: int) -> None:
    os.kill(pid, signal.SIGTERM)


@pytest.mark.parametrize("leave", [the_terminal_goes, told_to_go])
def test_it_ends_in_order_amid_drawing(
    leave: Callable[[int, int], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(tmp_path)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the test itself may run under nohup
        os.execv(sys.executable, [sys.executable, "-m", "openant_tools.cli"])
    code, shown, give_up = None, b"", time.monotonic() + PATIENCE_S
    try:
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        while b"Passport" not in shown:
            assert time.monotonic() < give_up, shown
            shown += os.read(terminal, 65536)
        os.write(terminal, b"s\x1bf")  # to one screen, back, to another
        leave(pid, terminal)
        while time.monotonic() < give_up:
            if leave is told_to_go:
                os.set_blocking(terminal, False)
                try:
                    os.read(terminal, 65536)  # as a terminal does
                except OSError:
                    pass
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                code = os.waitstatus_to_exitcode(status)
                break
            time.sleep(0.02)
    finally:
        if code is None:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    assert code == INTERRUPTED
    log = "\n".join(path.read_text() for path in (tmp_path / "state").rglob("*.log"))
    assert "openant_tools" in log
    assert "Traceback" not in log, log
