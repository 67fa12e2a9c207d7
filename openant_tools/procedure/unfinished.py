"""What a step had done when it was left in the middle, part by part (a joint, a leg): it goes on with the next part.

A part is noted once nothing of it is left to do, in the robot's folder, and the notes go when the step says yes. What of a part
can be read again, a procedure reads again before it trusts the note. What was done on a virtual robot is noted apart: the real one goes on
where it was itself.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, write_text

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = ["Parts", "Unfinished", "forget", "unfinished"]

SCHEMA = "openant.unfinished/1"
#: parts beyond which not each is named
NAMED = 8


@dataclass(frozen=True)
class Unfinished:
    """How far a step was when it was left.

    Attributes:
        of: every part, in order.
        done: part → what is known of it.
        date: when the last one was done, UTC.
    """

    of: tuple[str, ...]
    done: Mapping[str, Mapping[str, Any]]
    date: datetime.datetime

    @property
    def next(self) -> str:
        """The first part that is left to do."""
        return next(part for part in self.of if part not in self.done)

    def recording(self, folder: RobotFolder) -> Path | None:
        """The one that its parts were recorded in, of a step that goes on with it; None where it is not there."""
        path = folder.path / str(next(iter(self.done.values())).get("recording", ""))
        return path if path.is_file() else None

    @property
    def words(self) -> str:
        """`4 of 8`."""
        return f"{len(self.done)} of {len(self.of)}"

    @property
    def done_words(self) -> str:
        """`hip_rr, knee_rr`; of many parts the first and the last."""
        names = [part for part in self.of if part in self.done]
        return ", ".join(names) if len(names) <= NAMED else f"{names[0]} to {names[-1]}"


def unfinished(folder: RobotFolder, step: str, *, virtual: bool) -> Unfinished | None:
    """What a step has done of its parts, on a virtual robot or on the real one, where some and not all are done; None otherwise, and where
    the note is none.
    """
    try:
        said = read_json(_file(folder, step, virtual))
        if said["schema"] != SCHEMA:
            return None
        of = tuple(map(str, said["of"]))
        done = {str(part): dict(facts) for part, facts in said["done"].items() if part in of}
        date = datetime.datetime.fromisoformat(str(said["date"]))
    except (OSError, BadInput, ValueError, KeyError, TypeError, AttributeError):
        return None
    return Unfinished(of, done, date) if 0 < len(done) < len(of) else None


def forget(folder: RobotFolder, step: str, *, virtual: bool) -> None:
    """The step begins with its first part the next time."""
    _file(folder, step, virtual).unlink(missing_ok=True)


class _Bench(Protocol):
    """What of a `Bench` is asked here: findings are analysis' too, which knows no procedure."""

    @property
    def folder(self) -> RobotFolder: ...

    @property
    def virtual(self) -> bool: ...


class Parts:
    """The parts of a step that runs.

    Args:
        bench: of the robot. step: its name. of: all its parts, in order.
        named: joints that the builder has named: who names them wants them done anew, and nothing is noted.
    """

    def __init__(self, bench: _Bench, step: str, of: Sequence[str], named: Sequence[str] = ()) -> None:
        self._bench, self._step = bench, step
        #: all of them, in order
        self.of = tuple(of)
        left = None if named else unfinished(bench.folder, step, virtual=bench.virtual)
        #: part → what is known of it, of those that were done before
        self.before: Mapping[str, Mapping[str, Any]] = {} if left is None or left.of != self.of else left.done
        self._left = left if self.before else None
        self._done = dict(self.before)
        self._kept = not named

    def done(self, part: str, **facts: Any) -> None:
        """Note that nothing of a part is left to do, and what the next run must know of it."""
        self._done[part] = facts
        if self._kept:
            date = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
            note = {"schema": SCHEMA, "date": date.isoformat(), "of": list(self.of), "done": self._done}
            write_text(_file(self._bench.folder, self._step, self._bench.virtual), json_text(note))

    def end(self) -> None:
        """There is a result: it begins with its first part the next time, whatever the result says."""
        forget(self._bench.folder, self._step, virtual=self._bench.virtual)

    @property
    def words(self) -> str:
        """That it goes on where it was left, in a sentence; "" where it begins with its first part."""
        if self._left is None:
            return ""
        verb = "was" if len(self.before) == 1 else "were"
        return f"it goes on at {len(self.before) + 1} of {len(self.of)}: {self._left.done_words} {verb} done before"


def _file(folder: RobotFolder, step: str, virtual: bool) -> Path:
    return folder.path / "unfinished" / f"{step}{'.virtual' if virtual else ''}.json"
