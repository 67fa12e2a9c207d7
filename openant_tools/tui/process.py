"""A command of `openant` as a process: the same that one would type, with what it said in a file."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

from openant_tools.numbers import percent
from openant_tools.workers import PROGRESS, environment, passed_on

__all__ = ["Process"]

CLOSE_TIMEOUT_S = 30.0
#: bytes, more than a pipe holds
PIPE = 1 << 20


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
        self._told: int | None = None
        self._progress = ""
        self._since = 0

    @property
    def command(self) -> str:
        """As it is typed."""
        return shlex.join(["openant", *self.arguments])

    def start(self) -> None:
        """Start the process; one that was stopped goes on where it was."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self._forget_progress()
        told, tells = os.pipe()
        # Whoever works does not wait for a screen that does not look.
        os.set_blocking(told, False)
        os.set_blocking(tells, False)
        self._told = told
        with contextlib.closing(os.fdopen(tells, "wb")), self.log.open("ab") as log:
            self._since = log.tell()
            # A session of its own: Ctrl-C in the terminal is for the program, which then stops it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "openant_tools.cli", *self.arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, pass_fds=(tells,),
                env={**environment(), PROGRESS: str(tells)},
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
        self._forget_progress()

    @property
    def progress(self) -> str:
        """How far it is by its own words, `12 %  start 3 of 15`; "" before it told."""
        if self._told is not None:
            with contextlib.suppress(BlockingIOError):
                told = os.read(self._told, PIPE).decode(errors="replace").splitlines()
                heard = next((one for line in reversed(told) if (one := passed_on(line)) is not None), None)
                if heard is not None:
                    share, words = heard
                    self._progress = f"{percent(share)}  {words}"
        return self._progress

    def _forget_progress(self) -> None:
        told, self._told, self._progress = self._told, None, ""
        if told is not None:
            os.close(told)

    @property
    def said(self) -> list[str]:
        """The lines that it said since it was started."""
        try:
            with self.log.open("rb") as log:
                log.seek(self._since)
                return log.read().decode(errors="replace").strip().splitlines()
        except OSError:
            return []

    @property
    def last_words(self) -> str:
        """The last line that it said."""
        return next(reversed(self.said), "")
