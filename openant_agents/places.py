"""Where policies are played: the simulation, another robot's, or a robot behind its ports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openant_tools.errors import BadInput

__all__ = ["HARDWARE_ID", "SIMULATED_ID", "STARTS_IN_SIMULATION", "STARTS_ON_A_ROBOT", "Place", "simulated_options"]

SIMULATED_ID, HARDWARE_ID = "openant/Ant-v0", "openant/AntHardware-v0"
#: starts that a policy is measured from, where nobody says how many
STARTS_IN_SIMULATION, STARTS_ON_A_ROBOT = 15, 1


def simulated_options(options: Mapping[str, Any], robot: Path | None) -> dict[str, Any]:
    """How the simulation of a policy's environment is made, by how that was made (its `run.json`).

    Args:
        robot: the folder of another robot to walk in; None for the one it was trained on.
    """
    kept = {key: value for key, value in options.items() if key not in ("virtual", "clock", "record_pictures")}
    if robot is not None:
        kept.pop("kit", None)
        kept["robot"] = os.path.abspath(robot)
    return kept


@dataclass(frozen=True)
class Place:
    """One place, as it is named: `nominal`, `nominal:lite`, a robot's folder, `virtual:FILE`, `hardware:DIR`.

    Attributes:
        options: which robot, as its environment is told.
    """

    name: str
    options: Mapping[str, Any]

    @classmethod
    def named(cls, name: str) -> Place:
        """Raises BadInput where there is no such place."""
        kind, _, rest = name.partition(":")
        if kind == "nominal":
            return cls(name, {"kit": rest or "standard"})
        if kind == "virtual":
            return cls(name, {"virtual": rest if rest == "default" else os.path.abspath(rest)})
        if kind == "hardware":
            return cls(name, {"robot": os.path.abspath(rest)})
        if os.path.exists(name):
            return cls(name, {"robot": os.path.abspath(name)})
        raise BadInput(f"there is no such place: {name}", remedy="see `openant policies --help` for what a place is")

    @property
    def is_hardware(self) -> bool:
        """Whether it is a robot that nobody may let walk unasked."""
        return self.name.startswith("hardware:")

    @property
    def is_robot(self) -> bool:
        """Whether a robot is behind its ports there, which starts where it stands."""
        return self.is_hardware or self.name.startswith("virtual:")

    @property
    def starts(self) -> int:
        """How often a policy starts anew there, where nobody says."""
        return STARTS_ON_A_ROBOT if self.is_robot else STARTS_IN_SIMULATION

    def make(self, facts: Mapping[str, Any]) -> Any:
        """The environment, with the task, step and range of actions that a policy was trained with (`facts["options"]`)."""
        import gymnasium

        import openant_env  # noqa: F401  (registers the environments)

        kept = {key: facts["options"][key] for key in ("task", "dt", "action_range") if key in facts["options"]}
        name = HARDWARE_ID if self.is_robot else SIMULATED_ID
        return gymnasium.make(name, max_episode_steps=-1, **kept, **self.options)
