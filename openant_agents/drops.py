"""Reward drops: runs that walked and then all but stop, for no known reason (the paper's section on open problems).

A drop begins where the average reward over 120 s falls below a quarter of the best that the run had reached, if that was
walking at all (2 cm/s, the slowest that the paper calls competent) and had held for five minutes, and ends where it is
back at half of it. What
preceded it is compared from the log of transitions: the last two minutes in which the robot walked, and the two in which
it ceased to.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_agents.interventions import read_interventions
from openant_agents.runs import CurvePoint, load_checkpoint, read_facts
from openant_agents.training import TrainingProgress
from openant_env.metrics import WINDOW_S
from openant_tools.files import json_text, write_bytes, write_text

__all__ = ["Drop", "DropFinder", "DropWatch", "find_drops", "preceding", "write_drops"]

#: m/s, below which nothing can drop
WALKS_M_S = 0.02
#: shares of the best average
FALLEN, RECOVERED = 0.25, 0.5
#: s that a robot must have walked without a break for its stopping to be a drop, and not an agent that is yet to learn
STEADY_S = 300.0
#: |action| from which a joint is at the end of its range
SATURATED = 0.97

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drop:
    """One reward drop.

    Attributes:
        step: environment steps when it was found.
        from_s: s of robot time when it was found: up to 120 s after it began, which is the window of the average.
        until_s: s when the reward was back; None where it is not.
        best_m_s, lowest_m_s: m/s, the best average before, and the lowest since.
    """

    step: int
    from_s: float
    until_s: float | None
    best_m_s: float
    lowest_m_s: float


class DropFinder:
    """Finds reward drops in a learning curve, point by point.

    Attributes:
        drops: those that are over.
        open: the one that is not, if there is one.
    """

    def __init__(self) -> None:
        self.drops: list[Drop] = []
        self.open: Drop | None = None
        self._best = 0.0
        self._walks_since: float | None = None  # s; the average has not been below half of the best since
        self._walked_s = 0.0  # how long it last was so

    def add(self, point: CurvePoint) -> bool:
        """Look at the next point; True where a drop has just begun."""
        value, seconds = point.average_reward_m_s, point.seconds
        if seconds < WINDOW_S:
            return False  # the mean of a few steps is no average yet
        if self.open is not None:
            drop = replace(self.open, lowest_m_s=min(self.open.lowest_m_s, value))
            if value >= RECOVERED * self._best:
                self.drops.append(replace(drop, until_s=seconds))
                self.open, self._walks_since, self._walked_s = None, seconds, 0.0
            else:
                self.open = drop
            return False
        self._best = max(self._best, value)
        if value >= RECOVERED * max(self._best, WALKS_M_S):
            self._walks_since = seconds if self._walks_since is None else self._walks_since
            self._walked_s = seconds - self._walks_since
            return False
        self._walks_since = None
        if self._best < WALKS_M_S or value >= FALLEN * self._best or self._walked_s < STEADY_S:
            return False
        self.open = Drop(point.step, seconds, None, self._best, value)
        return True


def find_drops(points: Sequence[CurvePoint]) -> list[Drop]:
    """The reward drops in a learning curve, in order."""
    finder = DropFinder()
    for point in points:
        finder.add(point)
    return [*finder.drops, *([finder.open] if finder.open is not None else [])]


def preceding(folder: Path, drop: Drop) -> dict[str, Any]:
    """What the log of a run says about the time before a drop and about the time in which it came.

    Returns:
        `drop`, and for `walking` (the 120 s before the window that found it) and `falling` (that window): rewards and
        what the robot did: how far actions reached their ends, how much they changed, speeds of joints and of the body,
        and for SARSA which primitives it chose; the interventions of both; `changed_most`: what differs most, in
        standard deviations of the walking time.

    Raises:
        BadInput: the run cannot be read.
    """
    log = _Log(folder)
    spans = {
        "walking": (drop.from_s - 2.0 * WINDOW_S, drop.from_s - WINDOW_S),
        "falling": (drop.from_s - WINDOW_S, drop.from_s),
    }
    told: dict[str, Any] = {"schema": "openant.drop/1", "drop": asdict(drop)}
    parts = {name: log.between(*span) for name, span in spans.items()}
    for name, signals in parts.items():
        told[name] = {signal: float(values.mean()) for signal, values in signals.items() if len(values)}
        low, high = spans[name]
        told[name]["interventions"] = [
            asdict(event) for event in read_interventions(folder) if low < event.seconds <= high
        ]
        if log.primitives is not None:
            chosen = Counter(log.primitives[(log.seconds > low) & (log.seconds <= high)].tolist())
            told[name]["primitives"] = {str(key): count for key, count in sorted(chosen.items())}
    change = {
        signal: float((parts["falling"][signal].mean() - values.mean()) / values.std())
        for signal, values in parts["walking"].items()
        if len(values) > 1 and len(parts["falling"][signal]) and values.std() > 0.0 and signal != "reward_m_s"
    }
    told["changed_most"] = dict(sorted(change.items(), key=lambda item: -abs(item[1]))[:5])
    return told


class _Log:
    """The transitions of a run, read as signals over time.

    Attributes:
        seconds: (rows,) s, robot time at the end of each row.
        primitives: (rows,), of SARSA(λ); else None.
    """

    def __init__(self, folder: Path) -> None:
        facts, checkpoint = read_facts(folder), load_checkpoint(folder)
        observations, actions = int(facts["observations"]), int(facts["actions"])
        sarsa = facts["agent"] == "sarsa"
        width = int(checkpoint["transition_bytes"]) // 4
        count = int(checkpoint["transitions"])
        rows = np.fromfile(folder / "transitions.f32", np.float32, count * width).reshape(-1, width).astype(float)
        self._seen = rows[:, :observations]
        at = observations + (1 if sarsa else actions)
        self._reward, duration = rows[:, at], rows[:, at + 1]
        total = float(checkpoint["seconds"])
        self.seconds = total - duration.sum() + np.cumsum(duration)
        self._duration = duration
        self._actions = None if sarsa else rows[:, observations:at]
        self.primitives = rows[:, observations].astype(int) if sarsa else None
        names = facts["trained_on"].get("observation_names", [])
        self._blocks = {
            block: [k for k, name in enumerate(names) if name.startswith(block + ".")] for block in ("vel", "gyro")
        }
        self._names = list(names)

    def between(self, low: float, high: float) -> dict[str, Array]:
        """Signals of the rows that ended after `low` and not after `high` (s), each (rows,)."""
        rows = (self.seconds > low) & (self.seconds <= high)
        seen = self._seen[rows]
        signals: dict[str, Array] = {"reward_m_s": self._reward[rows] / self._duration[rows]}
        if self._actions is not None:
            actions = self._actions[rows]
            signals["action_size"] = np.abs(actions).mean(axis=1)
            signals["actions_at_their_ends"] = (np.abs(actions) > SATURATED).mean(axis=1)
            signals["action_change"] = np.abs(np.diff(actions, axis=0, prepend=actions[:1])).mean(axis=1)
        for block, columns in self._blocks.items():
            if columns:
                signals["joint_speed_rad_s" if block == "vel" else "body_rate_rad_s"] = np.abs(seen[:, columns]).mean(1)
        for k, name in enumerate(self._names):
            if name.startswith(("pos.", "acc.")):
                signals[name] = seen[:, k]
        return signals


def write_drops(folder: Path, points: Sequence[CurvePoint]) -> list[Path]:
    """Write what preceded each drop of a run to `drops/STEP.json`.

    Raises:
        BadInput: the run cannot be read.
        OSError: it cannot be written.
    """
    files = []
    for drop in find_drops(points):
        path = folder / "drops" / f"{drop.step}.json"
        write_text(path, json_text(preceding(folder, drop), indent=2))
        files.append(path)
    return files


class DropWatch:
    """Looks on while a run learns, and keeps the checkpoint nearest to a drop before the next one replaces it.

    Args:
        folder: the run's; the checkpoint goes to `drops/STEP.pt`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._finder = DropFinder()
        self._copying: threading.Thread | None = None

    def see(self, progress: TrainingProgress) -> Drop | None:
        """The drop that has just begun, if one has."""
        if not self._finder.add(CurvePoint(progress.step, progress.robot_seconds, progress.average_reward_m_s)):
            return None
        drop = self._finder.open
        assert drop is not None
        # Beside the loop: a robot that is learning waits for no disk.
        self._copying = threading.Thread(target=self._keep, args=(drop.step,), name="drop")
        self._copying.start()
        return drop

    def _keep(self, step: int) -> None:
        checkpoint = self._folder / "checkpoint.pt"
        if checkpoint.is_file():
            write_bytes(self._folder / "drops" / f"{step}.pt", checkpoint.read_bytes())

    def finish(self) -> None:
        """Wait until what is being kept is kept."""
        if self._copying is not None:
            self._copying.join()
