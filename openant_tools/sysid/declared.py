"""Parameters that a user declares: any number of any MJCF, in a few lines of TOML.

    kinds = ["stiffness", "damping"]      # of those known by name; default: those of every fit

    [[parameter]]
    name = "shin mass"
    element = "geom"                      # joint geom body inertial site actuator tendon pair equality option
    match = "shin*"                       # the elements' names, with * and ?
    attribute = "mass"                    # as in the file
    index = 0                             # which of its numbers, or a list of them; default all
    mode = "scale"                        # or "add"
    std = 0.1                             # the prior's deviation: relative, or in the attribute's unit with "add"
    low = 0.02                            # hard bounds of the value
    high = 0.05
    tie = "all"                           # one value for all that match, or "each"
    unit = "kg"

A model is compiled anew for each value that is tried, so that whatever follows from the number follows: the inertia from
a geom's mass, the pose of a child from its body's.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from openant_tools.errors import BadInput
from openant_tools.files import read_toml
from openant_tools.model.attribute import find
from openant_tools.model.plant import Plant
from openant_tools.numbers import literal
from openant_tools.sysid.kinds import KINDS, Kind
from openant_tools.sysid.parameter import Parameter, Place, given_numbers

__all__ = ["Declaration", "Declared", "declared_parameters", "read_declarations"]


@dataclass(frozen=True)
class Declared:
    """One entry: what may change, how far, and what it is called.

    Attributes:
        name: in the result; no dot in it, which separates a name from whose it is.
        element, match, attribute: where it stands in the MJCF.
        std: the prior's standard deviation, of log(value) with `scale`, else of the value.
        index: which of the attribute's numbers; None all.
        scale: whether values are multiplied (else added to).
        low, high: hard bounds of the value, of the first element that matches.
        each: whether every element that matches has a value of its own.
        unit: for reading.
    """

    name: str
    element: str
    match: str
    attribute: str
    std: float
    index: tuple[int, ...] | None = None
    scale: bool = True
    low: float = -math.inf
    high: float = math.inf
    each: bool = False
    unit: str = ""


@dataclass(frozen=True)
class Declaration:
    """A file of them.

    Attributes:
        path: the file.
        kinds: of the kinds known by name, those that it asks for; None where it says nothing.
        parameters: its entries.
    """

    path: Path
    kinds: tuple[str, ...] | None
    parameters: tuple[Declared, ...]


_KEYS: dict[str, type | tuple[type, ...]] = {
    "name": str,
    "element": str,
    "match": str,
    "attribute": str,
    "std": (int, float),
    "index": (int, list),
    "mode": str,
    "low": (int, float),
    "high": (int, float),
    "tie": str,
    "unit": str,
}
_NEEDED = ("name", "element", "attribute", "std")


def read_declarations(path: Path) -> Declaration:
    """Read a file of declared parameters.

    Raises:
        BadInput: there is no such file, it is not TOML, or an entry is not as above; the message names the entry.
    """
    try:
        table = read_toml(path)
    except OSError as error:
        raise BadInput(
            "no such file of parameters", where=path, remedy="name one with --parameters FILE.toml"
        ) from error
    unknown = [key for key in table if key not in ("kinds", "parameter")]
    if unknown:
        raise BadInput(f"unknown key {unknown[0]!r}", where=path, remedy="parameters stand in [[parameter]] tables")
    entries = table.get("parameter", [])
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise BadInput("no [[parameter]] in it", where=path, remedy="declare one: name, element, match, attribute, std")
    parameters = tuple(_entry(entry, k + 1, path) for k, entry in enumerate(entries))
    names = [parameter.name for parameter in parameters]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise BadInput(f"two parameters are called {twice[0]!r}", where=path, remedy="give each a name of its own")
    kinds = table.get("kinds")
    if kinds is not None and not (isinstance(kinds, list) and all(isinstance(kind, str) for kind in kinds)):
        raise BadInput("kinds is not a list of words", where=path, remedy='write kinds = ["stiffness", …]')
    return Declaration(path, None if kinds is None else tuple(kinds), parameters)


def _entry(entry: Mapping[str, Any], number: int, path: Path) -> Declared:
    named = entry.get("name")
    which = f"parameter {named!r}" if isinstance(named, str) else f"parameter {number}"

    def refuse(what: str, remedy: str) -> BadInput:
        return BadInput(f"{which}: {what}", where=path, remedy=remedy)

    for key, value in entry.items():
        if key not in _KEYS:
            near = difflib.get_close_matches(key, _KEYS, n=1)
            raise refuse(f"unknown key {key!r}", f"did you mean {near[0]!r}?" if near else f"keys: {', '.join(_KEYS)}")
        if not isinstance(value, _KEYS[key]) or isinstance(value, bool):
            raise refuse(f"{key} is {value!r}", f"give {_WORDS[_KEYS[key]]}")
    missing = [key for key in _NEEDED if key not in entry]
    if "match" not in entry and entry.get("element") != "option":
        missing.append("match")
    if missing:
        raise refuse(f"no {missing[0]}", f"an entry needs {', '.join(_NEEDED)} and match")
    name = str(entry["name"])
    if not re.fullmatch(r"[\w-]+( [\w-]+)*", name) or name in KINDS:
        raise refuse(
            "not a name for it", "use words of letters and digits, other than the kinds that are known by name"
        )
    for key, known in (("mode", ("scale", "add")), ("tie", ("all", "each"))):
        if entry.get(key, known[0]) not in known:
            raise refuse(f"{key} is {entry[key]!r}", f"choose {known[0]!r} or {known[1]!r}")
    try:
        std, low, high = (float(entry.get(k, d)) for k, d in (("std", 0), ("low", -math.inf), ("high", math.inf)))
    except OverflowError:
        raise refuse("a number too large", "give one below 1e308") from None
    if not (math.isfinite(std) and std > 0):
        raise refuse(f"std is {entry['std']!r}", "give the prior's standard deviation, above 0")
    if not low < high:
        raise refuse(f"low {literal(low)} is not below high {literal(high)}", "swap them")
    index = entry.get("index")
    if isinstance(index, list) and not (index and all(isinstance(k, int) for k in index)):
        raise refuse(f"index is {index!r}", "give one whole number, or a list of them, from 0")
    return Declared(
        name=name,
        element=str(entry["element"]),
        match=str(entry.get("match", "")),
        attribute=str(entry["attribute"]),
        std=std,
        index=None if index is None else tuple(index) if isinstance(index, list) else (index,),
        scale=entry.get("mode", "scale") == "scale",
        low=low,
        high=high,
        each=entry.get("tie", "all") == "each",
        unit=str(entry.get("unit", "")),
    )


_WORDS: dict[type | tuple[type, ...], str] = {
    str: "a text",
    (int, float): "a number",
    (int, list): "a whole number or a list of them",
}


def declared_parameters(plant: Plant, declaration: Declaration) -> list[Parameter]:
    """The parameters that a declaration means in a plant's file.

    Raises:
        BadInput: an entry means nothing there, or what it may not (scaling a number that is 0).
    """
    spec = mujoco.MjSpec.from_file(str(plant.path))
    out = []
    for entry in declaration.parameters:
        where = f"{declaration.path}, parameter {entry.name!r}, in {plant.path.name}"
        found = find(spec, entry.element, entry.match, entry.attribute, where)
        places = [Place(attribute, entry.index) for attribute in found]
        for place in places:
            _check(entry, place, plant.path, where)
        groups = [([place], str(place.attribute.name)) for place in places] if entry.each else [(places, "all")]
        for members, label in groups:
            out.append(_parameter(entry, members, label, plant))
    return out


def _check(entry: Declared, place: Place, model: Path, where: str) -> None:
    numbers = given_numbers(model, place.attribute)
    outside = [k for k in entry.index or () if not 0 <= k < len(numbers)]
    if outside:
        raise BadInput(
            f"{entry.attribute} has no number {outside[0]}", where=where, remedy=f"count from 0 to {len(numbers) - 1}"
        )
    chosen = place.numbers(numbers)
    if entry.scale and not any(chosen):
        raise BadInput(
            f"the {entry.attribute} of {place.attribute} is 0, and cannot be scaled",
            where=where,
            remedy='use mode = "add"',
        )
    if entry.scale and not chosen[0]:
        raise BadInput(
            f"the {entry.attribute} of {place.attribute} starts with 0",
            where=where,
            remedy="say with index which number",
        )
    if not entry.low <= chosen[0] <= entry.high:
        raise BadInput(
            f"the {entry.attribute} of {place.attribute} is {literal(chosen[0])}, outside {literal(entry.low)} … {literal(entry.high)}",
            where=where,
            remedy="widen low and high",
        )
    if entry.scale and chosen[0] <= 0 and (math.isfinite(entry.low) or math.isfinite(entry.high)):
        raise BadInput("a number below 0 that is scaled has no bounds", where=where, remedy='use mode = "add"')


def _parameter(entry: Declared, places: Sequence[Place], label: str, plant: Plant) -> Parameter:
    first = places[0]

    def read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
        return first.numbers(given_numbers(plant.path, first.attribute))[0]

    def write(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
        """Nothing: the model was compiled with it."""

    kind = Kind(
        entry.name,
        entry.unit or "1",
        read,
        write,
        entry.std,
        lambda limit: entry.std,
        low=entry.low,
        high=entry.high,
        body=True,
    )
    everything = tuple(range(len(plant.joints)))
    return Parameter(entry.name, label, everything, entry.scale, entry.std, kind, tuple(places))
