"""Training as a process: the same command that one would type, and how far it got, from the files that it writes."""

from __future__ import annotations

import csv
import importlib.util
import math
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

__all__ = ["AGENTS", "CurvePoint", "Training", "read_curve"]

#: agents that this version has
AGENTS: tuple[str, ...] = tuple(
    name for name in ("sac", "sarsa") if importlib.util.find_spec(f"openant_agents.{name}") is not None
)
CLOSE_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class CurvePoint:
    """One row of learning_curve.csv: steps, s of robot time, m/s over the last 120 s."""

    step: int
    seconds: float
    average_reward_m_s: float


@dataclass
class Training:
    """One `openant train`.

    Attributes:
        agent: as in `AGENTS`.
        robot: the robot's folder.
        folder: of the run; one that stands there goes on.
        where: in the robot's simulation, on the robot itself, or on a virtual robot (started for it, on its floor).
    """

    agent: str
    robot: Path
    steps: int
    seed: int
    folder: Path
    where: Literal["sim", "robot", "virtual"] = "sim"

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self.log = self.folder / "train.log"

    @property
    def arguments(self) -> tuple[str, ...]:
        """Of `openant`."""
        return (
            *("train", self.agent, "--robot", str(self.robot), "--steps", str(self.steps)),
            *("--seed", str(self.seed), "--out", str(self.folder)),
            # Who starts it on the screen has said there that the robot may move.
            *(() if self.where == "sim" else ("--env", "hardware", "--yes")),
            *(("--virtual",) if self.where == "virtual" else ()),
        )

    @property
    def command(self) -> str:
        """As it is typed."""
        return shlex.join(["openant", *self.arguments])

    def start(self) -> None:
        """Start the process, or go on with a run that was stopped."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            # A session of its own: Ctrl-C in the terminal is for the program, which then stops it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "openant_tools.cli", *self.arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
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


def read_curve(folder: Path) -> list[CurvePoint]:
    """The learning curve so far; a last line that is half written, or no file at all, is none."""
    points = []
    try:
        with (folder / "learning_curve.csv").open(encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                try:
                    point = CurvePoint(int(row["step"]), float(row["seconds"]), float(row["average_reward_m_s"]))
                except (KeyError, TypeError, ValueError):
                    continue
                if math.isfinite(point.average_reward_m_s):
                    points.append(point)
    except OSError:
        pass
    return points
