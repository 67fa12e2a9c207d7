"""What is handed on of a run: its rows, its samples, what was said while it was made and found in it since, its robot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.exchange.scene import DrawnRobot, load_scene
from openant_tools.files import read_json
from openant_tools.model.of_run import own_model
from openant_tools.recording.pictures import Picture, read_pictures
from openant_tools.recording.reader import Recording, Samples, read_recording
from openant_tools.recording.run import Run
from openant_tools.recording.tables import find_run, read_run
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.robot.folder import RobotFolder

__all__ = ["Saying", "Source", "read_source"]


@dataclass(frozen=True)
class Saying:
    """An event of a recording, or a finding that names it: when (s, the run's clock), whether it says no, in words."""

    t: float
    bad: bool
    words: str


@dataclass(frozen=True)
class Source:
    """A run that is exported.

    Attributes:
        run: its rows. recording: everything else, where it is one of ours.
        scene: its robot as it is drawn; None where nobody names a model.
        folder: the robot's, where the run lies in one.
        wall_ns: ns since 1970 where the run's clock is 0; None for a table, whose day nobody wrote down.
    """

    run: Run
    recording: Recording | None
    scene: DrawnRobot | None
    folder: RobotFolder | None
    wall_ns: int | None

    @property
    def imu(self) -> Samples:
        return self._samples("gyro.", "acc.") if self.recording is None else self.recording.imu

    @property
    def pose(self) -> Samples:
        return self._samples("base.") if self.recording is None else self.recording.pose

    def _samples(self, *starts: str) -> Samples:
        columns = {
            name: np.asarray(values, float) for name, values in self.run.columns.items() if name.startswith(starts)
        }
        return Samples(self.run.t if columns else np.zeros(0), columns)

    def pictures(self) -> Iterator[Picture]:
        """The overhead camera's, where they were recorded."""
        if self.recording is not None and len(self.recording.pictures.t) and self.run.path is not None:
            yield from read_pictures(self.run.path)

    def sayings(self) -> Iterator[Saying]:
        """Events in their order, then findings, at the end of the run that they are about."""
        for event in () if self.recording is None else self.recording.events:
            rest = {key: value for key, value in event.items() if key not in ("t", "kind")}
            words = f"{event.get('kind')}" + (f" {json.dumps(rest, ensure_ascii=False)}" if rest else "")
            yield Saying(float(event.get("t", self.run.t[0])), False, words)
        for finding in self.findings():
            verdict = finding.get("ok")
            yield Saying(
                float(self.run.t[-1]), verdict is False, f"{finding.get('step')}: {finding.get('what')}"
            )  # fmt: skip

    def findings(self) -> Iterator[Mapping[str, Any]]:
        """The findings of the robot's folder that name this recording."""
        if self.folder is None or self.run.path is None:
            return
        for path in sorted(self.folder.findings.glob("*.json")):
            try:
                content = read_json(path)
            except (OSError, BadInput):
                continue
            if isinstance(content, dict) and "step" in content and self.run.path.name in json.dumps(content):
                yield content


def read_source(path: Path, model: Path | None = None, *, draw: bool = True) -> Source:
    """The run at `path` with its robot, which is the one in whose `recordings/` it lies.

    Args:
        model: its MJCF; default: the one that it names, else that of its robot's folder.
        draw: whether anybody wants to see it.

    Raises:
        BadInput: the run or the model cannot be used.
    """
    path = find_run(path)
    recording = read_recording(path) if path.suffix == ".mcap" else None
    run = read_run(path, need=()) if recording is None else recording.run
    place = path.resolve().parent.parent
    folder = RobotFolder.at(place) if (place / CONFIG_NAME).is_file() else None
    if model is None and draw:
        model = own_model(run) or (None if folder is None else folder.model_path())
    wall_ns = None
    if recording is not None:
        wall = datetime.fromisoformat(str(recording.started["wall"])).timestamp()
        wall_ns = round(wall * 1e3) * 1_000_000 - round(float(recording.started["clock"]) * 1e9)
    return Source(run, recording, None if model is None else load_scene(model, run), folder, wall_ns)
