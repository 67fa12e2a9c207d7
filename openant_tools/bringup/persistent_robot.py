"""A virtual robot for the walk: it keeps what is written to its servos from one start to the next."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tomlkit

from openant_tools.bringup.simulated_builder import SimulatedBuilder
from openant_tools.errors import BadInput
from openant_tools.robot.config import editable_document
from openant_tools.virtual.process import VIRTUAL_DEFAULT, virtual_robot
from openant_tools.virtual.scenario import read_scenario_file

__all__ = ["PersistentRobot", "persistent_robot"]

#: What stands in the folder of a robot that is virtual.
SCENARIO, EEPROM = "virtual.toml", "virtual-eeprom.json"


@dataclass(frozen=True)
class PersistentRobot:
    """The ports of the virtual robot, and the builder who stands beside it."""

    bus: str
    imu: str | None
    camera: str | None
    control: str
    kit: str
    builder: SimulatedBuilder


@contextlib.contextmanager
def persistent_robot(source: str, folder: Path, clock: str | None = "stepped") -> Iterator[PersistentRobot]:
    """A robot of loose motors, or a scenario's; or one that runs already.

    Args:
        source: as `--virtual` gives it.
        folder: of the robot; the scenario and the servos' memory are kept there.
        clock: "stepped", or "real" for people who watch.
    """
    kit = "standard"
    if source == VIRTUAL_DEFAULT or source.endswith(".toml"):
        document = _scenario(source, folder)
        kit = str(document.get("robot", {}).get("kit", "standard"))
        if "sealed" not in document:
            path = folder / SCENARIO
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(tomlkit.dumps(document), encoding="utf-8")
            source = str(path)
    with virtual_robot(source, clock=clock) as found, contextlib.ExitStack() as stack:
        control = str(found["control"])
        builder = SimulatedBuilder(control)
        stack.callback(builder.close)
        yield PersistentRobot(str(found["bus"]), found["imu"], found["camera"], control, kit, builder)


def _scenario(source: str, folder: Path) -> tomlkit.TOMLDocument:
    """The scenario to start: the given one, or loose motors; with a file for the servos' memory where it names none."""
    if source == VIRTUAL_DEFAULT:
        kept = folder / SCENARIO
        document = editable_document(kept.read_bytes(), kept) if kept.is_file() else tomlkit.document()
    else:
        if not Path(source).is_file():
            raise BadInput("there is no such scenario", where=source, remedy="name a scenario (NAME.toml)")
        document = editable_document(read_scenario_file(Path(source))[0].encode(), source)
        if "sealed" in document:
            return document
    robot = document.setdefault("robot", tomlkit.table())
    robot.setdefault("setup", "loose" if source == VIRTUAL_DEFAULT else "stand")
    here = Path(source).parent if source != VIRTUAL_DEFAULT else folder
    robot["eeprom"] = str((here / str(robot.get("eeprom", (folder / EEPROM).resolve()))).resolve())
    return document
