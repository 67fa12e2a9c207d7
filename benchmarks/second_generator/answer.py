"""One drawn answer, as `openant gap blind make --maker COMMAND` hands it over (docs/blind.md, "Makers")."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["Answer", "CannotHave", "Effect", "read_answer"]


class CannotHave(Exception):
    """This physics cannot have what was drawn: the robot is left out of the set."""


@dataclass(frozen=True)
class Effect:
    """One effect of the catalogue; `joints` are names, "all" or "body"."""

    name: str
    joints: tuple[str, ...] | str
    parameters: Mapping[str, Any]


@dataclass(frozen=True)
class Answer:
    """What is true of one robot.

    Attributes:
        robot: its name in the set. model: the nominal MJCF, which the diagnosis is given.
        seed: of everything that the answer leaves open.
        outside: what the catalogue has no name for, with its joint and strength (about 1) in `parameters`.
    """

    robot: str
    model: Path
    seed: int
    tracker: bool
    effects: tuple[Effect, ...] = ()
    outside: str | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> set[str]:
        return {effect.name for effect in self.effects}


def read_answer(path: Path) -> Answer:
    table = json.loads(path.read_text(encoding="utf-8"))
    effects = tuple(
        Effect(
            one["effect"], one["joints"] if isinstance(one["joints"], str) else tuple(one["joints"]), one["parameters"]
        )
        for one in table["effects"]
    )
    return Answer(
        table["robot"], Path(table["model"]), int(table["seed"]), bool(table["tracker"]), effects, table.get("outside"),
        table.get("parameters", {}),
    )  # fmt: skip
