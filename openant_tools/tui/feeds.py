"""Where the numbers on the screen come from: an engine's telemetry, or a recording played again. Both give the same rows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.ring import COMMON, ERR_CODES, SIGNALS, columns
from openant_tools.numbers import number, span
from openant_tools.recording.run import Run

__all__ = ["WINDOW_S", "Feed", "History", "LiveFeed", "ReplayFeed"]

Array = NDArray[np.float64]

#: what the strips show
WINDOW_S = 10.0
#: of the width of its bounds: what a value must be beyond them, so that noise at an end is no news
OUTSIDE_SHARE = 0.02


#: first part of a column's name → its unit, of those whose bounds are measured
UNITS = {"pos": "rad", "vel": "rad/s", "gyro": "rad/s", "acc": "m/s²"}


class Feed(Protocol):
    """A source of rows.

    Attributes:
        title: for the top line.
        joints: in the order of the rows' columns (`comms.ring.columns`).
    """

    title: str
    joints: tuple[str, ...]

    def rows(self) -> Array:
        """Rows (n, columns) since the last call, oldest first."""
        ...

    def close(self) -> None: ...


class LiveFeed:
    """An engine's ring, read with a place of our own: neither the engine nor who drives it notices."""

    def __init__(self, engine: EngineProcess, title: str) -> None:
        self.engine = engine
        self.title = title
        self.joints = tuple(servo.joint for servo in engine.config.servos)
        self._ring = engine.second_view()
        self._seen = self._ring.count

    @property
    def ended(self) -> bool:
        return self.engine not in EngineProcess.running

    def rows(self) -> Array:
        rows, self._seen = self._ring.since(self._seen)
        return rows

    def close(self) -> None:
        self._ring.close()


class ReplayFeed:
    """A recording as if it came now.

    Attributes:
        position_s: since its start.
        playing, speed: how it goes on.
        jumped: whether it was set elsewhere since the last rows; what is on the screen then belongs to another time.
    """

    def __init__(self, run: Run, clock: Callable[[], float] = time.monotonic) -> None:
        self.run = run
        self.title = f"replay of {run.name}"
        self.joints = run.joints
        self.playing = True
        self.speed = 1.0
        self.jumped = False
        self._clock = clock
        self._then = clock()
        self._table = _table(run)
        self._position_s = 0.0
        self._row = 0

    @property
    def position_s(self) -> float:
        return self._position_s

    @property
    def duration_s(self) -> float:
        return self.run.duration_s

    def seek(self, position_s: float) -> None:
        """Go to a time; the window before it is shown at once."""
        self._position_s = min(max(position_s, 0.0), self.duration_s)
        start = self.run.t[0] + self._position_s - WINDOW_S if len(self.run.t) else 0.0
        self._row = int(np.searchsorted(self.run.t, start))
        self.jumped = True

    def rows(self) -> Array:
        now = self._clock()
        if self.playing:
            self._position_s = min(self._position_s + (now - self._then) * self.speed, self.duration_s)
            self.playing = self._position_s < self.duration_s
        self._then = now
        end = int(np.searchsorted(self.run.t, self.run.t[0] + self._position_s, side="right")) if len(self.run.t) else 0
        rows = self._table[self._row : end]
        self._row = max(self._row, end)
        return rows

    def close(self) -> None:
        pass


class History:
    """The rows of the last seconds, for whoever draws them.

    Attributes:
        t: (n,) s. rows: (n, columns).
        bounds: name of a column → measured (low, high) of it, for what is observed (`[observation]` of robot.toml).
        over: whether nobody reads any more: what stands here was read last.
        live: whether rows should come by themselves.

    Args:
        before: the history of the same robot until now: its last values stand until there are new ones.
    """

    def __init__(
        self,
        joints: Sequence[str],
        bounds: Mapping[str, tuple[float, float]] | None = None,
        *,
        live: bool = False,
        before: History | None = None,
    ) -> None:
        self.joints = tuple(joints)
        self.over = False
        self.live = live
        self.bounds = dict(bounds or {})
        self._index = {name: k for k, name in enumerate(columns(joints))}
        self._ok = np.array([self._index[f"ok.{joint}"] for joint in self.joints], int)
        self.rows: Array = np.empty((0, len(self._index)))
        #: the last value of each column that was a number; s of the last answer of each joint, in the rows' time
        self._known = np.full(len(self._index), np.nan)
        self._answered = np.full(len(self.joints), np.nan)
        self._before: Mapping[str, float] = {} if before is None else before.all_known()
        #: s since a row came
        self.quiet_s = 0.0
        #: what others have worked out of these rows, by joint; gone with the next rows
        self.worked_out: dict[str, Any] = {}

    @property
    def t(self) -> Array:
        return self.rows[:, 0]

    def add(self, rows: Array) -> None:
        if len(rows):
            self.worked_out.clear()
            known = np.isfinite(rows)
            last = len(rows) - 1 - known[::-1].argmax(axis=0)
            self._known = np.where(known.any(axis=0), rows[last, np.arange(rows.shape[1])], self._known)
            # Of a joint that has not answered yet, since the first row.
            self._answered = np.where(np.isnan(self._answered), rows[0, 0], self._answered)
            answered = rows[:, self._ok] > 0
            last = len(rows) - 1 - answered[::-1].argmax(axis=0)
            self._answered = np.where(answered.any(axis=0), rows[last, 0], self._answered)
            self.rows = np.concatenate([self.rows, rows])
            self.rows = self.rows[np.searchsorted(self.t, self.t[-1] - WINDOW_S) :]

    def wait(self, quiet_s: float) -> None:
        """Take in that no row came for so many s."""
        if int(quiet_s) != int(self.quiet_s):
            self.worked_out.clear()
        self.quiet_s = quiet_s

    def silent_s(self, joint: str) -> float:
        """How long a joint has not answered, in s, however long that is."""
        return float(self.t[-1] - self._answered[self.joints.index(joint)]) if len(self.rows) else 0.0

    def all_known(self) -> dict[str, float]:
        """Column → its last value, of this robot's earlier rows, too."""
        return {**self._before, **{name: value for name in self._index if (value := self.last_known(name)) == value}}

    def read(self, angles_rad: Mapping[str, float], t: float) -> None:
        """Take in what a procedure has read of all its joints by itself, torque off."""
        row = dict.fromkeys(self._index, np.nan) | {"t": t, "torque": 0.0}
        for joint, angle in angles_rad.items():
            row |= {f"pos.{joint}": angle, f"ok.{joint}": 1.0, f"err.{joint}": 0.0}
        self.add(np.array([list(row.values())]))

    def left(self) -> History:
        """What was read last, torque off, once who read it has ended."""
        out = History(self.joints, before=self)
        out.over = True
        if len(self.rows):
            row = np.array([[self.last_known(name) for name in self._index]])
            row[0, self._index["torque"]] = 0.0
            out.add(row)
        return out

    def clear(self) -> None:
        self.rows = self.rows[:0]
        self._known[:] = self._answered[:] = np.nan
        self.worked_out.clear()

    def column(self, name: str) -> Array:
        """(n,) one column by its name in a run table."""
        out: Array = self.rows[:, self._index[name]]
        return out

    def newest(self, name: str) -> float:
        """The last value of a column; NaN where there is none."""
        return float(self.rows[-1, self._index[name]]) if len(self.rows) else float("nan")

    def outside(self, name: str) -> str:
        """How the newest value of a column is outside its measured bounds, in words; "" where it is not."""
        low, high = self.bounds.get(name, (-np.inf, np.inf))
        slack = OUTSIDE_SHARE * (high - low) if np.isfinite(high - low) else 0.0
        value = self.newest(name) if name in self._index else np.nan
        if not (value < low - slack or value > high + slack):
            return ""
        unit = UNITS.get(name.partition(".")[0], "")
        return f"{name} is {number(value, unit)}, outside its bounds {span(low, high, unit)}"

    def last_known(self, name: str) -> float:
        """The last value that was a number, however long ago; NaN where there was none."""
        known = float(self._known[self._index[name]]) if name in self._index else float("nan")
        return known if known == known else self._before.get(name, float("nan"))


def _table(run: Run) -> Array:
    """A run as rows of the ring."""
    codes = {word: code for code, word in enumerate(ERR_CODES)}
    out = np.full((len(run.t), len(COMMON) + len(SIGNALS) * len(run.joints)), np.nan)
    for k, name in enumerate(columns(run.joints)):
        signal, _, joint = name.partition(".")
        if name == "t":
            out[:, k] = run.t
        elif name == "torque":
            out[:, k] = run.signal("torque", default=1.0).max(axis=1, initial=0.0)
        elif signal == "err" and joint in run.joints:
            words = run.columns.get(name)
            out[:, k] = 0.0 if words is None else [codes.get(str(word), 1) for word in words]
        elif signal == "ok" and joint in run.joints:
            answered = np.isfinite(run.column(f"pos.{joint}")).astype(float)
            out[:, k] = run.column(name) if name in run.columns else answered
        else:
            out[:, k] = run.column(name)
    return out
