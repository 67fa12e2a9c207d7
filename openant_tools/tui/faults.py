"""What is wrong now, from the newest rows; and faults that stay until somebody has seen them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from openant_tools.comms.guards import Guards
from openant_tools.comms.ring import ERR_CODES
from openant_tools.numbers import number
from openant_tools.tui.feeds import History
from openant_tools.tui.marks import Name

__all__ = ["Condition", "FaultList", "ShownFault", "condition"]

#: the engine's own idea of a servo that is lost
SILENT_S = Guards().silent_s or 0.25
#: s without a row from which on what stands on the screen is not of now
QUIET_S = 1.0
BUS = "bus"


@dataclass(frozen=True)
class Condition:
    """How one joint is, as a mark and a word.

    Attributes:
        fault: where somebody should know even when it is over.
        since: the word with its time, where the last values of the joint are not of now.
    """

    mark: Name
    word: str
    fault: str = ""
    since: str = ""


def condition(history: History, joint: str) -> Condition:
    """One joint's condition, of the newest rows; it is what its answers say, no more."""
    found: Condition | None = history.worked_out.get(joint)
    if found is None:
        found = history.worked_out[joint] = _condition(history, joint)
    return found


def _condition(history: History, joint: str) -> Condition:
    if joint not in history.joints or not len(history.rows):
        known = np.isfinite(history.last_known(f"pos.{joint}"))
        return Condition("off", "old", since="last read") if known else Condition("todo", "no data")
    quiet_s = history.quiet_s
    if history.live and not history.over and quiet_s >= QUIET_S:
        return Condition("warn", "unread", since=f"unread {_ago(quiet_s)}")
    if history.over or quiet_s >= QUIET_S:
        return Condition("off", "old", since=f"{_ago(quiet_s)} ago" if quiet_s >= QUIET_S else "last read")
    code = history.newest(f"err.{joint}")
    word = ERR_CODES[int(code)] if np.isfinite(code) and 0 <= code < len(ERR_CODES) else ""
    if word == "alert":
        return Condition("fail", "alert", "reports a hardware error: `openant comms reboot` says which")
    if not history.newest(f"ok.{joint}") > 0:
        silent = history.silent_s(joint)
        if silent >= SILENT_S:
            since = f"silent {_ago(silent)}" if silent >= QUIET_S else "silent"
            return Condition("fail", "silent", f"does not answer ({word or 'no word'}): `openant comms scan`", since)
        return Condition("warn", word or "late")
    outside = history.outside(f"pos.{joint}") or history.outside(f"vel.{joint}")
    if outside:
        return Condition("warn", "outside", outside)
    return Condition("ok", "ok")


def _ago(seconds: float) -> str:
    """A time in the past in whole seconds or minutes."""
    minutes = seconds >= 60.0
    return number(math.floor(seconds / 60 if minutes else seconds), "min" if minutes else "s", decimals=0)


@dataclass(frozen=True)
class ShownFault:
    """One thing that went wrong.

    Attributes:
        where: a joint, a step, or "".
        over: whether it has gone by itself meanwhile.
    """

    where: str
    words: str
    over: bool = False

    def __str__(self) -> str:
        return ": ".join(part for part in (self.where, self.words) if part) + (" (over now)" if self.over else "")


class FaultList:
    """The faults that nobody has acknowledged, oldest first; the same one twice counts once."""

    def __init__(self) -> None:
        self._open: dict[str, ShownFault] = {}

    @property
    def unseen(self) -> tuple[ShownFault, ...]:
        return tuple(self._open.values())

    def note(self, where: str, words: str) -> None:
        """Something went wrong; it stays until `see`."""
        self._open[where or words] = ShownFault(where, words)

    def is_over(self, where: str) -> None:
        """It has gone by itself; it still has to be seen."""
        fault = self._open.get(where)
        if fault is not None and not fault.over:
            self._open[where] = ShownFault(fault.where, fault.words, over=True)

    def watch(self, history: History) -> None:
        """Take in what the newest rows say of each joint; where most are silent it is the bus."""
        found = {joint: condition(history, joint) for joint in history.joints}
        silent = [joint for joint, one in found.items() if one.word == "silent"]
        if len(silent) > max(1.0, len(found) / 2):
            self.note(
                BUS, f"{len(silent)} of {len(found)} servos do not answer: power, first cable, or a busy computer"
            )
            return
        self.is_over(BUS)
        for joint, one in found.items():
            if one.fault:
                self.note(joint, one.fault)
            elif one.mark == "ok":
                self.is_over(joint)
        for name in (name for name in history.bounds if name.partition(".")[2] not in history.joints):
            outside = history.outside(name)
            if outside:
                self.note(name, outside)
            else:
                self.is_over(name)

    def see(self) -> None:
        """Somebody has looked at all of them; what is still wrong comes again."""
        self._open.clear()
