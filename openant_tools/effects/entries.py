"""`[[effect]]` entries (formats, section 4), to and from what simulations take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import tomlkit
from numpy.typing import NDArray

from openant_tools.effects.catalogue import acting, catalogue
from openant_tools.effects.commands import SEND_S, CommandEffects
from openant_tools.effects.rollout import EffectValues
from openant_tools.effects.sensing import SensingEffects
from openant_tools.errors import BadInput
from openant_tools.files import read_toml
from openant_tools.numbers import literal, stored
from openant_tools.robot.config import ConfigProblem, parse_effects
from openant_tools.robot.config import EffectEntry as Entry
from openant_tools.robot.pair import OTHER_REMEDY, PLAIN, mark_of, stranger_words, strangers

__all__ = ["as_toml", "check_pair", "commands_of", "entries_of", "read_effects", "sensing_of", "values_of"]


def read_effects(path: Path, joints: Sequence[str]) -> tuple[Entry, ...]:
    """The `[[effect]]` entries of a file.

    Args:
        joints: the robot's.

    Raises:
        BadInput: the file cannot be read, or an entry says something that cannot be.
    """
    problems: list[ConfigProblem] = []
    entries = parse_effects(read_toml(path).get("effect", []), problems, joints)
    errors = [problem for problem in problems if problem.severity == "error"]
    if errors:
        raise BadInput(errors[0].what, where=f"{path}, {errors[0].place}", remedy=errors[0].remedy)
    return entries


def check_pair(
    entries: Sequence[Entry], model: mujoco.MjModel, path: Path, where: str | Path | None = None
) -> list[str]:
    """Refuse effects that were fitted with another model; what else is to be said of both together, a line each.

    Args:
        entries: all that shall act with the model.
        path, where: the files of the model and of the entries, for messages.

    Raises:
        BadInput: an effect of another pair than the model.
    """
    others = strangers(entries, model)
    if others:
        raise BadInput(stranger_words(others, path), where=where or "robot.toml, [[effect]]", remedy=OTHER_REMEDY)
    own, active = mark_of(model), [entry for entry in entries if entry.enabled]
    by_hand = dict.fromkeys(entry.effect for entry in active if entry.pair is None and entry.effect in acting())
    if own == PLAIN and by_hand:
        return [
            f"{path} was fitted without effects: what it lacked of {', '.join(by_hand)} it has as friction or gain already, which "
            "counts twice now → fit it with these in robot.toml, or set enabled = false"
        ]
    if own not in (None, PLAIN) and not any(entry.effect in acting() for entry in active):
        return [
            f"{path} was fitted with effects that do not act here, and is not the best without → play it with its "
            "`calibrated.effects.toml` or from its robot's folder, or take the plain `calibrated.xml`"
        ]
    return []


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
        if not entry.enabled or _acts_on(entry) is not None:
            continue
        effect = acting().get(entry.effect)
        if effect is None:
            raise BadInput(
                f"the effect {entry.effect} does not act as an entry: MuJoCo carries it, in the model",
                where=where,
                remedy="write it into the model with `openant gap apply`, or leave it out: effects=False, `--no-effects`, "
                "enabled = false",
            )
        known = {parameter.name: parameter for parameter in effect.parameters}
        chosen = list(joints) if isinstance(entry.joints, str) else list(entry.joints)
        rows = [list(joints).index(joint) for joint in chosen if joint in joints]
        for name, value in entry.parameters.items():
            if name not in known:
                raise BadInput(
                    f"{entry.effect} has no parameter {name!r}", where=where, remedy=f"it has {', '.join(known)}"
                )
            number = value[0] if isinstance(value, list) and len(value) == 1 else value
            parameter = known[name]
            if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
                raise BadInput(
                    f"{entry.effect}.{name} is no number: {value!r}", where=where, remedy=f"in {parameter.unit}"
                )
            if not parameter.low <= number <= parameter.high:
                raise BadInput(
                    f"{entry.effect}.{name} = {literal(number)} {parameter.unit} is not physical",
                    where=where,
                    remedy=f"it lies between {literal(parameter.low)} and {literal(parameter.high)}",
                )
            values.setdefault((entry.effect, name), np.zeros(len(joints)))[rows] = float(number)
    return values


def commands_of(
    entries: Sequence[Entry], joints: Sequence[str], where: str | Path | None = None
) -> CommandEffects | None:
    """What `[[effect]]` entries say of commands on their way; None where they say nothing.

    Raises:
        BadInput: a parameter that an effect does not have, or a value out of bounds.
    """
    jitter_s, longest_s, shared, fraction = 0.0, SEND_S, True, np.zeros(len(joints))
    for entry in entries:
        if not entry.enabled or _acts_on(entry) != "commands":
            continue
        given = _numbers(entry, where)
        if entry.effect == "clock_jitter":
            jitter_s = float(np.hypot(jitter_s, _within(entry, "std_s", given, where)))
            continue
        chosen = joints if isinstance(entry.joints, str) else entry.joints
        rows = [k for k, joint in enumerate(joints) if joint in chosen]
        fraction[rows] = np.maximum(fraction[rows], _within(entry, "fraction", given, where))
        longest_s = max(longest_s, _within(entry, "longest_s", given, where))
        shared = shared and len(rows) == len(joints)
    return CommandEffects(jitter_s, fraction, longest_s, shared) if jitter_s or fraction.any() else None


def sensing_of(entries: Sequence[Entry], where: str | Path | None = None) -> SensingEffects | None:
    """What `[[effect]]` entries say of the IMU and the tracker; None where they say nothing.

    Biases are `rad_s` and `m_s2` (effects.md), three numbers each, or axis by axis as diagnoses write them.

    Raises:
        BadInput: a parameter that an effect does not have, or a value out of bounds.
    """
    biases = {"gyro": np.zeros(3), "acc": np.zeros(3)}
    scale, yaw_rad, latency_s = 1.0, 0.0, 0.0
    mine = [entry for entry in entries if entry.enabled and _acts_on(entry) == "sensors"]
    for entry in mine:
        given = _numbers(entry, where)
        if entry.effect == "imu_bias":
            for sensor, whole in (("gyro", "rad_s"), ("acc", "m_s2")):
                parts = [given.get(f"{sensor}_{axis}", [0.0])[0] for axis in "xyz"]
                vector = given.get(whole, parts)
                if len(vector) != 3:
                    raise BadInput(f"imu_bias.{whole} is no vector of three", where=where, remedy="give x, y and z")
                biases[sensor] += vector
            continue
        scale *= _within(entry, "scale", given, where)
        yaw_rad += _within(entry, "yaw_rad", given, where)
        latency_s += _within(entry, "latency_s", given, where)
    return SensingEffects(biases["gyro"], biases["acc"], scale, yaw_rad, latency_s) if mine else None


def _acts_on(entry: Entry) -> str | None:
    """What the environment applies an effect to, where it does not act between steps."""
    effect = catalogue().get(entry.effect)
    return None if effect is None else effect.acts_on


def _numbers(entry: Entry, where: str | Path | None) -> dict[str, list[float]]:
    out = {}
    known = [parameter.name for parameter in catalogue()[entry.effect].parameters]
    for name, value in entry.parameters.items():
        if name not in known:
            raise BadInput(
                f"{entry.effect} has no parameter {name!r}", where=where, remedy=f"it has {', '.join(known)}"
            )
        numbers = value if isinstance(value, list) else [value]
        if not numbers or not all(
            isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) for x in numbers
        ):
            raise BadInput(f"{entry.effect}.{name} is no number: {value!r}", where=where, remedy="give it in SI units")
        out[name] = [float(x) for x in numbers]
    return out


def _within(entry: Entry, name: str, given: dict[str, list[float]], where: str | Path | None) -> float:
    parameter = catalogue()[entry.effect].parameter(name)
    number = given.get(name, [parameter.absent])[0]
    if not parameter.low <= number <= parameter.high:
        raise BadInput(
            f"{entry.effect}.{name} = {literal(number)} is not physical",
            where=where,
            remedy=f"it lies between {literal(parameter.low)} and {literal(parameter.high)}",
        )
    return number


def entries_of(values: EffectValues, joints: Sequence[str]) -> list[Entry]:
    """The entries that say these values, one for each effect and set of joints that share its parameters."""
    effects = dict.fromkeys(name for name, _ in values)
    entries = []
    for name in effects:
        mine = {parameter: value for (effect, parameter), value in values.items() if effect == name}
        groups: dict[tuple[tuple[str, float], ...], list[str]] = {}
        for j, joint in enumerate(joints):
            # Six digits: more than any interval leaves meaning to.
            sizes = tuple((parameter, stored(value[j])) for parameter, value in mine.items() if value[j])
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
        if entry.pair is not None:
            table["pair"] = entry.pair
        tables.append(table)
    document["effect"] = tables
    return tomlkit.dumps(document)
