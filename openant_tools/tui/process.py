"""A command of `openant` as a process: the same that one would type, with what it said in a file."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from pathlib import Path

from openant_tools.workers import environment

__all__ = ["Process"]

CLOSE_TIMEOUT_S = 30.0


class Process:
    """One command, which goes on whatever is on the screen.

    Args:
        arguments: of `openant`.
        log: what it says is added to this file.
    """

    def __init__(self, arguments: tuple[str, ...], log: Path) -> None:
        self.arguments = arguments
        self.log = log
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def command(self) -> str:
        """As it is typed."""
        return shlex.join(["openant", *self.arguments])

    def start(self) -> None:
        """Start the process; one that was stopped goes on where it was."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            # A session of its own: Ctrl-C in the terminal is for the program, which then stops it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "openant_tools.cli", *self.arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, env=environment(),
            )  # fmt: skip

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """None while it runs, or before."""
        return None if self._process is None else self._process.poll()

    def stop(self) -> None:
        """Ask it to save and stop, as Ctrl-C does; `running` says when it has."""
        if self._process is not None and self.running:
            self._process.send_signal(signal.SIGINT)

    def close(self) -> None:
        """Stop, and wait for it."""
        self.stop()
        if self._process is not None:
            try:
                self._process.wait(CLOSE_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    @property
    def last_words(self) -> str:
        """The last line that it said."""
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""
