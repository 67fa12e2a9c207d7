"""What identification may change in a model, one parameter at a time.

A parameter is a physical quantity of one joint, or of several joints tied together. Internally it is one number u in units
of its prior's standard deviation, 0 at the prior: quantities that the model states (stiffness 18.6 N·m/rad) are scaled,
value = nominal · exp(σ u), so that joints of different size can be tied and runs may bring models of their own gains;
quantities that the model lacks (friction 0) are added, value = nominal + σ u.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import effect
from openant_tools.effects.rollout import EffectValues
from openant_tools.model.attribute import Attribute, stated
from openant_tools.model.plant import Plant
from openant_tools.model.servo import hold_still, usual_torque
from openant_tools.numbers import literal
from openant_tools.sysid.kinds import ACTION_DELAY, ELECTRICAL_DAMPING, KINDS, LOAD_FRICTION, Kind

__all__ = [
    "ACTION_DELAY",
    "KINDS",
    "Kind",
    "Parameter",
    "Place",
    "apply",
    "buffered",
    "by_register",
    "choose",
    "colours",
    "delays",
    "effect_values",
    "given_numbers",
    "names_of",
    "restatements",
    "unloaded",
]

Array = NDArray[np.float64]
#: kinds that a servo's registers set: its P gain, its D gain
OF_REGISTERS = ("stiffness", "velocity_gain")
#: share of its torque limit that a servo's gear takes unloaded, and its deviation
UNLOADED, UNLOADED_STD = 0.03, 0.015
#: share of a servo's damping that is back-EMF, and its deviation: of five servos on a bench (docs/effects.md), none of which is
#: among the recordings that judge us
BACK_EMF, BACK_EMF_STD = 0.92, 0.06


@dataclass(frozen=True)
class Parameter:
    """One unknown of a fit: a kind of quantity for one joint, or for several joints that share it.

    Attributes:
        kind: a key of KINDS.
        label: the joint, the servo model, `all`, the links of one mass by the first word of their joints' names, or `body`.
        joints: indices into the plant's joints.
        relative: whether u scales the model's value (else it is added).
        std: the prior's standard deviation, of log(value) if relative, else in the kind's unit.
        declared: the kind, where a user declared it (`declared.py`).
        places: of what was declared, the attributes that change together, and which of an attribute's numbers.
        model: the file whose servos alone it belongs to, where runs were made with several; None for all.
        centre: u where the prior has its middle: 0, the given model's value, unless physics knows better.
    """

    kind: str
    label: str
    joints: tuple[int, ...]
    relative: bool
    std: float
    declared: Kind | None = None
    places: tuple[Place, ...] = ()
    model: Path | None = None
    centre: float = 0.0

    def belongs(self, plant: Plant) -> bool:
        """Whether it says anything of this plant."""
        return self.model is None or self.model == plant.path

    @property
    def name(self) -> str:
        return f"{self.kind}.{self.label}"

    @property
    def definition(self) -> Kind:
        return self.declared or KINDS[self.kind]

    def value(self, nominal: float, u: float) -> float:
        """The physical value that the internal number u stands for, given the model's own."""
        return nominal * math.exp(self.std * u) if self.relative else nominal + self.std * u

    def bounds(self, nominal: float) -> tuple[float, float]:
        """The internal numbers between which the value stays physical."""
        kind = self.definition
        if self.relative:
            low = math.log(kind.low / nominal) / self.std if kind.low > 0 else -math.inf
            return low, math.log(kind.high / nominal) / self.std if math.isfinite(kind.high) else math.inf
        return (kind.low - nominal) / self.std, (kind.high - nominal) / self.std


def apply(plant: Plant, parameters: Sequence[Parameter], u: Array) -> mujoco.MjModel:
    """A copy of the plant's model with every parameter at its u."""
    values = restatements(plant.path, parameters, u)
    model = copy.copy(_restated(plant, tuple(values.items())) if values else plant.model)
    constants = False
    for parameter, value in zip(parameters, u, strict=True):
        kind = parameter.definition
        if not parameter.belongs(plant):
            continue
        for j in parameter.joints[:1] if kind.body else parameter.joints:
            nominal = kind.read(plant.model, plant, j)
            kind.write(model, plant, j, parameter.value(nominal, float(value)))
        constants |= kind.constants
    if u.any() and any(parameter.kind == LOAD_FRICTION for parameter in parameters):
        hold_still(model, plant)  # a gear under load sticks
    if constants:
        mujoco.mj_setConst(model, _scratch(plant.model))
    return model


@lru_cache(maxsize=8)
def _scratch(model: mujoco.MjModel) -> mujoco.MjData:
    """Data of a model and of all of its layout, to compute in: making them takes longer than what is computed."""
    return mujoco.MjData(model)


@dataclass(frozen=True)
class Place:
    """Numbers of one attribute that a declared parameter changes: all of them, or those at `index`."""

    attribute: Attribute
    index: tuple[int, ...] | None = None

    def numbers(self, values: tuple[float, ...]) -> tuple[float, ...]:
        return values if self.index is None else tuple(values[k] for k in self.index)


def restatements(path: Path, parameters: Sequence[Parameter], u: Array) -> dict[Attribute, tuple[float, ...]]:
    """What the attributes that were declared are, in the file at `path`, with the parameters at u; those that moved."""
    out: dict[Attribute, tuple[float, ...]] = {}
    for parameter, value in zip(parameters, u, strict=True):
        for place in parameter.places if value else ():
            numbers = list(out.get(place.attribute) or given_numbers(path, place.attribute))
            for k in range(len(numbers)) if place.index is None else place.index:
                numbers[k] = parameter.value(numbers[k], float(value))
            out[place.attribute] = tuple(numbers)
    return out


@lru_cache(maxsize=4)
def _spec(path: Path, written: int) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(path))


def given_numbers(path: Path, attribute: Attribute) -> tuple[float, ...]:
    """An attribute's numbers in a file."""
    return stated(_spec(path, path.stat().st_mtime_ns), attribute, path)


_compiled: dict[tuple[object, ...], mujoco.MjModel] = {}
#: variants of one Jacobian mostly share what was declared: only its own columns are compiled anew
COMPILED_KEPT = 64


def _restated(plant: Plant, values: tuple[tuple[Attribute, tuple[float, ...]], ...]) -> mujoco.MjModel:
    key = (plant.path, plant.path.stat().st_mtime_ns, plant.joints, plant.setup, plant.form, plant.timestep, values)
    if key not in _compiled:
        while len(_compiled) >= COMPILED_KEPT:
            del _compiled[next(iter(_compiled))]
        _compiled[key] = plant.restated(dict(values))
    return _compiled[key]


def effect_values(
    plant: Plant, parameters: Sequence[Parameter], u: Array, given: EffectValues | None = None
) -> dict[tuple[str, str], Array]:
    """(effect, its parameter) → (joints,) of the effects that act between steps, with the parameters at u.

    Args:
        given: what acts besides, at joints whose value no parameter says.
    """
    out = {key: np.array(value, float) for key, value in (given or {}).items()}
    for parameter, value in zip(parameters, u, strict=True):
        key = parameter.definition.effect
        if key is not None:
            out.setdefault(key, np.zeros(len(plant.joints)))[list(parameter.joints)] = parameter.std * value
    return {key: value for key, value in out.items() if value.any()}


def delays(plant: Plant, parameters: Sequence[Parameter], u: Array) -> Array:
    """(joints,) s by which the parameters at u let commands act later than the given model does."""
    out = np.zeros(len(plant.joints))
    for parameter, value in zip(parameters, u, strict=True):
        if parameter.kind == ACTION_DELAY:
            out[list(parameter.joints)] = parameter.std * value
    # A microsecond moves nothing; shifting commands by it would cost as much as by a millisecond.
    return np.where(np.abs(out) > 1e-6, out, 0.0)


def buffered(plant: Plant, model: mujoco.MjModel, late: Array) -> None:
    """Put delays (joints,) into the buffers of a model loaded with `delayed=True`.

    The newest command in a buffer is one step old, so that MuJoCo makes a whole step of any delay between none and one.
    """
    for j, delay in enumerate(late):
        total = float(plant.model.actuator_delay[plant.actuator[j]]) + float(delay)
        model.actuator_delay[plant.actuator[j]] = total if total > plant.timestep / 2 else 0.0


def colours(
    plant: Plant, parameters: Sequence[Parameter], *, coupled: bool, some: Sequence[bool] | None = None
) -> list[tuple[list[int], list[NDArray[np.bool_]]]]:
    """Parameters that can be varied in one rollout, because they move joints of different kinematic trees.

    On the stand the legs do not move each other (the torso is fixed), so that one rollout serves one parameter of each leg.

    Args:
        coupled: everything moves everything, as on the floor.
        some: which parameters to vary; default all.

    Returns:
        for each colour, the indices of its parameters and, for each, the mask of the joints that it moves.
    """
    coupled |= any(effect(key[0]).shared for p in parameters if (key := p.definition.effect) is not None)
    everywhere = set(plant.tree.tolist())
    out: list[tuple[set[int], list[int], list[NDArray[np.bool_]]]] = []
    for p, parameter in enumerate(parameters):
        if some is not None and not some[p]:
            continue
        alone = coupled or parameter.definition.body or not parameter.joints
        trees = set(everywhere) if alone else {int(plant.tree[j]) for j in parameter.joints}
        mask = np.isin(plant.tree, list(trees))
        for used, members, masks in out:
            if not used & trees:
                used |= trees
                members.append(p)
                masks.append(mask)
                break
        else:
            out.append((trees, [p], [mask]))
    return [(members, masks) for _, members, masks in out]


def choose(
    plant: Plant, kinds: Sequence[str], tie: str = "joint", motors: dict[str, str] | None = None
) -> list[Parameter]:
    """The parameters of these kinds, one a joint, one a servo model (`tie="servo"`), or one for all (`tie="all"`).

    Kinds that a model cannot have are left out: a torque limit where the actuator has none. Of a kind that belongs to the
    body there is one; links of the same mass share theirs, whatever `tie` says.
    """
    chosen = []
    for name in kinds:
        kind = KINDS[name]
        for label, joints in _groups(plant, kind, tie, motors or {}).items():
            if not all(kind.holds(plant.model, plant, j) for j in joints):
                continue
            nominals = [kind.read(plant.model, plant, j) for j in joints]
            limit = float(np.mean([usual_torque(plant.model, plant, j) for j in joints]))
            relative = kind.relative_std is not None and all(value > 0 for value in nominals)
            std = kind.relative_std if relative and kind.relative_std is not None else kind.absolute_std(limit)
            centre = 0.0 if kind.prior is None else (kind.prior - float(np.mean(nominals))) / std
            chosen.append(Parameter(name, label, tuple(joints), relative, std, centre=centre))
    return chosen


def unloaded(parameter: Parameter, plant: Plant) -> Parameter:
    """A parameter's prior beside a friction that follows the load, of which motions with torque on hardly tell.

    Dry friction is then the share of the torque limit that a gear takes while it carries nothing. What the model says of it
    stays its prior. Where it says nothing, none at all is the least likely: a joint that then falls and swings would never
    come to rest. And not all of the damping is back-EMF: grease brakes, too. (Without it, dry friction is that of loaded
    gears, which brakes a falling joint more than the grease does.)
    """
    kind, joints = parameter.definition, parameter.joints
    given = [kind.read(plant.model, plant, j) for j in joints]
    if parameter.kind == ELECTRICAL_DAMPING:
        return replace(parameter, std=BACK_EMF_STD, centre=(BACK_EMF - float(np.mean(given))) / BACK_EMF_STD)
    if parameter.kind != "coulomb_friction" or max(given) > 0:
        return parameter
    limit = float(np.mean([usual_torque(plant.model, plant, j) for j in joints]))
    return replace(parameter, std=UNLOADED_STD * limit, centre=UNLOADED / UNLOADED_STD)


def by_register(parameters: Sequence[Parameter], plants: Sequence[Plant]) -> list[Parameter]:
    """The parameters of runs that were made with several models of one robot: what its registers set is each model's own.

    Friction, inertia and zeros are the servo's, whatever its gains.
    """
    paths = list(dict.fromkeys(plant.path for plant in plants))
    if len(paths) < 2:
        return list(parameters)
    names = names_of(paths)
    return [
        one
        for parameter in parameters
        for one in (
            [
                replace(parameter, model=path, label=f"{parameter.label}.{name}")
                for path, name in zip(paths, names, strict=True)
            ]
            if parameter.kind in OF_REGISTERS
            else [parameter]
        )
    ]


def names_of(paths: Sequence[Path]) -> list[str]:
    """What models are called beside each other: by their files, with as many of their folders as tells them apart."""
    parts = [(*path.relative_to(path.anchor).parent.parts, path.stem) for path in paths]
    names: list[str] = []
    for folders in range(max(map(len, parts))):
        names = ["-".join(each[-1 - folders :]) for each in parts]
        if len(set(names)) == len(names):
            break
    return names


def _groups(plant: Plant, kind: Kind, tie: str, motors: Mapping[str, str]) -> dict[str, list[int]]:
    """Label → the joints that share one value of a kind."""
    if kind.body:
        return {"body": list(range(len(plant.joints)))}
    groups: dict[str, list[int]] = {}
    if kind.alike:
        by_value: dict[str, list[int]] = {}
        for j in range(len(plant.joints)):
            by_value.setdefault(literal(kind.read(plant.model, plant, j)), []).append(j)
        for members in by_value.values():
            words = {plant.joints[j].partition("_")[0] for j in members}
            shared = words.pop() if len(words) == 1 else plant.joints[members[0]]
            groups[shared if shared not in groups else plant.joints[members[0]]] = members
        return groups
    for j, joint in enumerate(plant.joints):
        label = {"joint": joint, "servo": motors.get(joint, "all"), "all": "all"}[tie]
        groups.setdefault(label, []).append(j)
    return groups
