"""The effects that are here: every module of this package with an `effect`."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import numpy as np

from openant_tools import effects
from openant_tools.effects.effect import Action, Effect
from openant_tools.effects.robot import Reference, Robot
from openant_tools.errors import BadInput

__all__ = ["acting", "action", "catalogue", "effect", "enter"]


@cache
def catalogue() -> dict[str, Effect]:
    """Name → effect, in the order of their names."""
    found = {}
    for module in sorted(pkgutil.iter_modules(effects.__path__), key=lambda module: module.name):
        one = getattr(importlib.import_module(f"{effects.__name__}.{module.name}"), "effect", None)
        if isinstance(one, Effect):
            found[one.name] = one
    return found


@cache
def acting() -> dict[str, Effect]:
    """Those that act between steps, because MuJoCo has no feature for them, or none that many robots at once can have."""
    return {name: one for name, one in catalogue().items() if one.law is not None}


def effect(name: str) -> Effect:
    """The effect of that name that acts between steps.

    Raises:
        BadInput: there is none.
    """
    known = acting()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        remedy = f"did you mean {near[0]!r}?" if near else f"these act between steps: {', '.join(sorted(known))}"
        raise BadInput(f"no effect is called {name!r}", remedy=remedy)
    return known[name]


def action(one: str, other: str) -> Action | None:
    """What tells two effects apart where commands and positions cannot, if anything is known to."""
    return catalogue()[one].told_from.get(other) or catalogue()[other].told_from.get(one)


def enter(robot: Robot, reference: Reference, causes: Iterable[tuple[str, Sequence[int], Mapping[str, float]]]) -> None:
    """Give a robot effects.

    Args:
        causes: names, indices of joints, and coordinates.
    """
    for name, joints, x in causes:
        cause, at = catalogue()[name], np.array(joints)
        cause.enter(robot, at, cause.values(x, reference, at))
