"""`[[effect]]` entries (formats, section 4), to and from what simulations take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tomlkit
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.rollout import EffectValues
from openant_tools.errors import BadInput
from openant_tools.robot.config import Effect as Entry

__all__ = ["as_toml", "entries_of", "values_of"]


def values_of(entries: Sequence[Entry], joints: Sequence[str], where: str | Path | None = None) -> EffectValues:
    """What `[[effect]]` entries say, by effect, parameter and joint.

    Args:
        entries: of robot.toml or a file of effects; those that are not enabled count for nothing.
        joints: the plant's, in order.
        where: the file, for messages.

    Raises:
        BadInput: an effect that cannot act between steps, a parameter that it does not have, or a value out of bounds.
    """
    values: dict[tuple[str, str], NDArray[np.float64]] = {}
    for entry in entries:
        if not entry.enabled:
            continue
        effect = catalogue().get(entry.effect)
        if effect is None:
            raise BadInput(
                f"the effect {entry.effect} cannot act in this simulation yet",
                where=where,
                remedy="simulate without: effects=False, `--no-effects`, or enabled = false in the file",
            )
        known = {quantity.name: quantity for quantity in effect.quantities}
        chosen = list(joints) if isinstance(entry.joints, str) else list(entry.joints)
        rows = [list(joints).index(joint) for joint in chosen if joint in joints]
        for name, value in entry.parameters.items():
            if name not in known:
                raise BadInput(
                    f"{entry.effect} has no parameter {name!r}", where=where, remedy=f"it has {', '.join(known)}"
                )
            number = value[0] if isinstance(value, list) and len(value) == 1 else value
            quantity = known[name]
            if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
                raise BadInput(
                    f"{entry.effect}.{name} is no number: {value!r}", where=where, remedy=f"in {quantity.unit}"
                )
            if not quantity.low <= number <= quantity.high:
                raise BadInput(
                    f"{entry.effect}.{name} = {number:g} {quantity.unit} is not physical",
                    where=where,
                    remedy=f"it lies between {quantity.low:g} and {quantity.high:g}",
                )
            values.setdefault((entry.effect, name), np.zeros(len(joints)))[rows] = float(number)
    return values


def entries_of(values: EffectValues, joints: Sequence[str]) -> list[Entry]:
    """The entries that say these values, one for each effect and set of joints that share its parameters."""
    effects = dict.fromkeys(name for name, _ in values)
    entries = []
    for name in effects:
        mine = {parameter: value for (effect, parameter), value in values.items() if effect == name}
        groups: dict[tuple[tuple[str, float], ...], list[str]] = {}
        for j, joint in enumerate(joints):
            # Six digits: more than any interval leaves meaning to.
            sizes = tuple((parameter, float(f"{value[j]:.6g}")) for parameter, value in mine.items() if value[j])
            if sizes:
                groups.setdefault(sizes, []).append(joint)
        entries += [Entry(name, tuple(where), dict(sizes)) for sizes, where in groups.items()]
    return entries


def as_toml(entries: Sequence[Entry], note: str = "") -> str:
    """A file of effects, as it stands beside a model."""
    document = tomlkit.document()
    if note:
        document.add(tomlkit.comment(note))
    tables = tomlkit.aot()
    for entry in entries:
        table = tomlkit.table()
        table["effect"] = entry.effect
        table["joints"] = entry.joints if isinstance(entry.joints, str) else list(entry.joints)
        parameters = tomlkit.inline_table()
        parameters.update(entry.parameters)
        table["parameters"] = parameters
        table["enabled"] = entry.enabled
        tables.append(table)
    document["effect"] = tables
    return tomlkit.dumps(document)
