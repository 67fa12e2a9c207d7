"""The guardian from the engine's side: started, told whether torque is on, replaced where it was ended from outside."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time

from openant_tools.comms import guardian
from openant_tools.errors import HardwareFault
from openant_tools.numbers import literal

__all__ = ["BEAT_S", "PATIENCE_S", "GuardianProcess"]

#: Silence of the engine, s, after which its guardian switches torque off, and how often the engine says that it lives.
PATIENCE_S, BEAT_S = 1.0, 0.1
#: s. Guardians that are ended so soon after each other: another would fare no better.
GUARDIAN_LIFE_S = 1.0


class GuardianProcess:
    """One guardian at a time, on an open port.

    Args:
        packet: what switches torque off.
        patience_s: silence after which it is sent, torque being on; 0 for never.
    """

    def __init__(self, packet: bytes, patience_s: float) -> None:
        self._packet, self._patience_s = packet, patience_s
        self._process: subprocess.Popen[bytes] | None = None
        #: when one was replaced last, s of this computer
        self._replaced_at = -float("inf")
        #: when it was told last how we are, s of this computer
        self.told_at = -float("inf")

    @property
    def pid(self) -> int | None:
        """None where there is none."""
        return None if self._process is None else self._process.pid

    def start(self, port: int) -> None:
        """Have one guard what this file descriptor is open on.

        Raises:
            HardwareFault: this computer lets no process begin.
        """
        program = [sys.executable, "-I", "-S", guardian.__file__]
        words = [*program, str(port), self._packet.hex(), literal(self._patience_s)]
        try:
            self._process = subprocess.Popen(words, stdin=subprocess.PIPE, pass_fds=(port,), start_new_session=True)
        except OSError as error:
            raise HardwareFault(
                f"the guardian that switches torque off if this program dies cannot be started ({error.strerror})",
                remedy="make room on this computer: processes, memory",
            ) from None
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self.told_at = -float("inf")

    def tell(self, holding: bool) -> None:
        """That we live, and whether torque is on."""
        self.told_at = time.monotonic()
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):  # it has gone: the next cycle sees to it
                os.write(self._process.stdin.fileno(), b"+" if holding else b"-")

    def ended(self) -> bool:
        """Whether it was killed, or stopped for good."""
        if self._process is None:
            return False
        try:
            how = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            return True
        return how is not None

    def replace(self, port: int, holding: bool) -> str:
        """Another one in place of one that was ended; why nobody guards now as one should, empty where someone does."""
        gone, self._process = self._process, None
        if gone is not None:
            gone.kill()
            gone.wait()
            if gone.stdin is not None:
                gone.stdin.close()
        now, before = time.monotonic(), self._replaced_at
        self._replaced_at = now
        try:
            self.start(port)
        except HardwareFault as error:
            return error.what
        return "so was the one before it" if now - before < GUARDIAN_LIFE_S and holding else ""

    def forsake(self) -> None:
        """Let it find out that nobody speaks to it any more: then it switches torque off, once more."""
        self._process = None

    def dismiss(self) -> None:
        """Send it home: nothing needs guarding any more."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.write(b"bye")
                self._process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            self._process = None
