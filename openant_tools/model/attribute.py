"""Any number of an MJCF, by element, name and attribute as they stand in the file: found, read, and set.

What a class of defaults says of an element is what the element says. Units are the file's own (angles in degrees where its
compiler says so).
"""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from openant_tools.errors import BadInput

__all__ = ["ELEMENTS", "Attribute", "Stated", "find", "set_stated", "stated"]

#: element as in a declaration → the spec's elements of that kind
ELEMENTS: dict[str, Callable[[mujoco.MjSpec], Sequence[Any]]] = {
    "joint": lambda spec: spec.joints,
    "geom": lambda spec: spec.geoms,
    "body": lambda spec: spec.bodies,
    "inertial": lambda spec: spec.bodies,
    "site": lambda spec: spec.sites,
    "actuator": lambda spec: spec.actuators,
    "tendon": lambda spec: spec.tendons,
    "pair": lambda spec: spec.pairs,
    "equality": lambda spec: spec.equalities,
    "option": lambda spec: [spec.option],
}
#: attributes that a spec spells otherwise than a file, by element where it matters
_SPELLED = {
    "solreflimit": "solref_limit",
    "solimplimit": "solimp_limit",
    "solreffriction": "solref_friction",
    "solimpfriction": "solimp_friction",
    "inertial.pos": "ipos",
    "inertial.diaginertia": "inertia",
}


@dataclass(frozen=True)
class Attribute:
    """One attribute of one element.

    Attributes:
        element: a key of ELEMENTS.
        name: the element's name (an inertial's is its body's; the option has none).
        attribute: as in the file.
    """

    element: str
    name: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.element} {self.name!r}" if self.name else self.element


Stated = Mapping[Attribute, tuple[float, ...]]


def find(spec: mujoco.MjSpec, element: str, match: str, attribute: str, where: Path | str) -> list[Attribute]:
    """The attributes that a pattern (`shin*`) means.

    Raises:
        BadInput: there is no such element or attribute, nothing of that name, or no number in it.
    """
    if element not in ELEMENTS:
        raise BadInput(f"no element is called {element!r}", where=where, remedy=_near(element, ELEMENTS))
    if element == "option":
        found = [Attribute(element, "", attribute)]
    else:
        names = [str(one.name) for one in ELEMENTS[element](spec) if one.name]
        matching = fnmatch.filter(names, match)
        if not matching:
            raise BadInput(f"no {element} is called {match!r}", where=where, remedy=_near(match, names))
        found = [Attribute(element, name, attribute) for name in matching]
    for one in found:
        _numbers(spec, one, where)
    return found


def stated(spec: mujoco.MjSpec, attribute: Attribute, where: Path | str = "") -> tuple[float, ...]:
    """The numbers of an attribute."""
    return _numbers(spec, attribute, where)


def set_stated(spec: mujoco.MjSpec, values: Stated) -> None:
    """Set attributes of a spec, before it is compiled."""
    for attribute, numbers in values.items():
        owner, spelled = _owner(spec, attribute, ""), _spelled(attribute)
        if isinstance(getattr(owner, spelled), np.ndarray):
            getattr(owner, spelled)[:] = numbers
        else:
            setattr(owner, spelled, numbers[0])


def _numbers(spec: mujoco.MjSpec, attribute: Attribute, where: Path | str) -> tuple[float, ...]:
    owner, spelled = _owner(spec, attribute, where), _spelled(attribute)
    value = getattr(owner, spelled, None)
    numbers: tuple[float, ...]
    if isinstance(value, float):
        numbers = (value,)
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
        numbers = tuple(float(x) for x in value)
    else:
        real = [name for name in dir(owner) if not name.startswith("_") and _is_real(getattr(owner, name))]
        named = {next((k.rpartition(".")[2] for k, v in _SPELLED.items() if v == name), name) for name in real}
        raise BadInput(
            f"a {attribute.element} has no number called {attribute.attribute!r}",
            where=where,
            remedy=_near(attribute.attribute, sorted(named)),
        )
    if not all(np.isfinite(numbers)):
        raise BadInput(
            f"{attribute} does not say its {attribute.attribute}",
            where=where,
            remedy="state it in the file, or choose the attribute that is stated there (density for mass)",
        )
    return numbers


def _is_real(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")


def _owner(spec: mujoco.MjSpec, attribute: Attribute, where: Path | str) -> Any:
    if attribute.element == "option":
        return spec.option
    named = ELEMENTS[attribute.element](spec)
    for one in named:
        if one.name == attribute.name:
            return one
    remedy = _near(attribute.name, [str(one.name) for one in named if one.name])
    raise BadInput(f"no {attribute.element} is called {attribute.name!r}", where=where, remedy=remedy)


def _spelled(attribute: Attribute) -> str:
    own = f"{attribute.element}.{attribute.attribute}"
    return _SPELLED.get(own, _SPELLED.get(attribute.attribute, attribute.attribute))


def _near(word: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    near = difflib.get_close_matches(word.rstrip("*"), list(known), n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    listed = ", ".join(list(known)[:12])
    return f"there are {listed}{', …' if len(known) > 12 else ''}" if known else "name them in the file first"
