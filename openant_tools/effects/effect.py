"""What an effect is: its name, sizes and tolerance, how it enters a simulated robot and a model, and what tells it from others.

An effect is one object of one file. It is a hypothesis of the diagnosis, which draws and fits its `quantities`; where MuJoCo has
no feature for it, a law that acts between steps or something that befalls commands or sensors, whose `parameters` are what
`[[effect]]` entries say (formats, section 4); and where identification can fit it, `kinds` of numbers in a model.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum, auto
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.document import Writer
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.step import Law

__all__ = [
    "Action",
    "Cause",
    "Effect",
    "Ints",
    "Parameter",
    "Quantity",
    "Scope",
    "Table",
    "Values",
    "amount",
    "factor",
    "rate",
    "shape",
    "share",
    "usual_torque",
]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
#: parameter → value, in the catalogue's units
Values = Mapping[str, float]
#: parameter → its value at each joint of each simulation, (n, joints); 0 where the effect is absent
Table = Mapping[str, Array]
Scale = Callable[[Reference, Ints], float]


class Scope(StrEnum):
    """What an effect may belong to (effects.md)."""

    JOINT = "j"
    SERVO = "g"
    ALL = "a"
    BODY = "b"


@dataclass(frozen=True)
class Quantity:
    """One size of an effect, and the coordinate x in which it is drawn and fitted: x = 0 is the absence of the effect.

    Attributes:
        name, unit: of the value, as in the catalogue.
        value: x, and the scale of the robot and joints at hand, to the value; back: the other way round.
        small, large: |x| just beyond what robots of one build differ by, and of a robot that is clearly ill.
        signed: x may be negative.
        scale: what an x of 1 means on this robot.
        shape: it says how an effect acts, not how much: never absent, drawn between small and large.
        levels: from how many values of a shape it is sought, because what it makes has many valleys.
        share: it is a shape between 0 and 1, any of them as likely.
        tolerance: of the value, or of a factor's logarithm, within which robots of one build differ; 0 where nothing is known.
    """

    name: str
    unit: str
    value: Callable[[float, float], float]
    back: Callable[[float, float], float]
    small: float
    large: float
    signed: bool
    scale: Scale
    shape: bool = False
    levels: int = 1
    share: bool = False
    tolerance: float = 0.0

    def allowed(self, reference: Reference, joints: Ints) -> float:
        """|x| of a robot at the edge of the tolerance."""
        return self.tolerance / self.scale(reference, joints)

    def between(self, way: float) -> float:
        """Of a shape, the value so far (0 … 1) between its least and its largest: by logarithms, unless it is a share."""
        if self.share:
            return self.small + (self.large - self.small) * way
        return float(self.small * (self.large / self.small) ** way)

    def sought(self) -> list[float]:
        """The values of a shape from which it is sought, evenly between its ends."""
        return [self.between((k + 0.5) / self.levels) for k in range(self.levels)]


def _one(reference: Reference, joints: Ints) -> float:
    return 1.0


def amount(
    name: str,
    unit: str,
    small: float,
    large: float,
    *,
    signed: bool = False,
    scale: Scale = _one,
    tolerance: float = 0.0,
) -> Quantity:
    """A value that is 0 where the effect is absent."""
    return Quantity(
        name, unit, lambda x, s: s * x, lambda v, s: v / s, small, large, signed, scale, tolerance=tolerance
    )


def factor(name: str, small: float, large: float, *, tolerance: float) -> Quantity:
    """A factor, 1 where the effect is absent; |x| is the size of its logarithm."""
    return Quantity(
        name, "1", lambda x, s: float(np.exp(x)), lambda v, s: float(np.log(v)), small, large, True, _one,
        tolerance=tolerance,
    )  # fmt: skip


def rate(name: str, unit: str, small: float, large: float, scale: Scale) -> Quantity:
    """A limit, infinite where the effect is absent; x is the scale over it."""
    return Quantity(
        name, unit, lambda x, s: s / x if x > 0 else float("inf"), lambda v, s: s / v, small, large, False, scale
    )


def shape(name: str, unit: str, low: float, high: float, *, levels: int = 1) -> Quantity:
    """A parameter of how it acts."""
    return Quantity(name, unit, lambda x, s: x, lambda v, s: v, low, high, False, _one, shape=True, levels=levels)


def share(name: str) -> Quantity:
    """A parameter of how it acts that is a share of something."""
    return Quantity(name, "1", lambda x, s: x, lambda v, s: v, 0.0, 1.0, False, _one, shape=True, share=True)


def usual_torque(reference: Reference, joints: Ints) -> float:
    """N·m that these joints' servos usually give: by it torques of effects are sized."""
    return float(reference.torque[joints].mean())


def everywhere(reference: Reference) -> bool:
    """It can show on any robot."""
    return True


@dataclass(frozen=True)
class Parameter:
    """A number of an `[[effect]]` entry.

    Attributes:
        name, unit: as in the catalogue, SI.
        std: a size of which a robot's own is expected, one standard deviation of a fit's prior; of a torque (N·m), as a
            share of the servo's torque limit; None for what is not fitted.
        low, high: between which it is physical. absent: its value where nothing is said.
        shown_by: the protocols that show it best.
    """

    name: str
    unit: str
    std: float | None = None
    low: float = 0.0
    high: float = float("inf")
    absent: float = 0.0
    shown_by: str = ""


class Chance(Enum):
    """What befalls commands at random times."""

    LOST = auto()
    SCATTERED = auto()


class Action(NamedTuple):
    """What to do, or to record, to tell two effects apart: its name, and in a sentence."""

    name: str
    words: str


@dataclass(frozen=True)
class Effect:
    """An effect of the catalogue.

    Attributes:
        name, family: of the catalogue. words: what happens, for people.
        scopes: what it may belong to.
        quantities: its sizes.
        enter: changes a robot so that it has the effect: (robot, indices of joints, values).
        native: whether a written MJCF carries it with MuJoCo's own features.
        writer: edits such a file, where its robot compiled to a model of the same layout (`Robot.model`) does not say it yet.
        kinds: numbers of a model by which identification fits it.

        law: makes the law that acts between steps, for given parameters. order: laws of lower order act first: supply, then
            setpoints, then torques, then what follows from torques.
        parameters: of `[[effect]]` entries; all absent is no effect.
        shared: what one joint does acts on all, and there is one value for the robot.
        acts_on: what an environment applies it to, where it is no law.

        vector: sizes share one magnitude in a random direction; else each is drawn by itself.
        shows: whether it can show on what was recorded.
        signal: the signal of the log that it acts on, where that is not the motion itself. told: whether it acts on what joints tell
            of their motion.
        silent: whether command and encoder shift alike, so that joint positions hardly show it.
        unseen: names of quantities that joint positions do not show.
        random: what happens at random times, where it does: no simulation repeats that.
        stated: from the quantities to the catalogue's parameters, where those are not the same.
        restored: from a diagnosis' parameters back to the quantities, with what its coordinates were.
        told_from: effect → what tells this one from it, where commands and positions alone cannot, or hardly (effects.md).
    """

    name: str
    family: str
    words: str
    scopes: tuple[Scope, ...]
    quantities: tuple[Quantity, ...]
    enter: Callable[[Robot, Ints, Values], None]
    native: bool
    writer: Writer | None = None
    kinds: tuple[Kind, ...] = ()
    law: Callable[[Table], Law] | None = None
    order: int = 0
    parameters: tuple[Parameter, ...] = ()
    shared: bool = False
    acts_on: Literal["commands", "sensors"] | None = None
    vector: bool = False
    shows: Callable[[Reference], bool] = everywhere
    signal: str | None = None
    told: bool = False
    silent: bool = False
    unseen: frozenset[str] = frozenset()
    random: Chance | None = None
    stated: Callable[[Values, Reference, Ints], dict[str, float]] = lambda values, reference, joints: dict(values)
    restored: Callable[[Values, Values, Reference, Ints], dict[str, float]] = lambda given, x, reference, joints: dict(
        given
    )
    told_from: Mapping[str, Action] = field(default_factory=dict, hash=False)

    @property
    def chief(self) -> Parameter | None:
        """The parameter that is a law's size in its usual form, where one is: others are other forms of it, or its shape."""
        first = self.parameters[0]
        return first if len(self.parameters) == 1 or first.name == "coefficient" else None

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(parameter for parameter in self.parameters if parameter.name == name)

    def quantity(self, name: str) -> Quantity:
        """The quantity of that name."""
        return next(quantity for quantity in self.quantities if quantity.name == name)

    @property
    def of_body(self) -> bool:
        """Whether it belongs to the body or the world, and to no joint."""
        return self.scopes == (Scope.BODY,)

    @property
    def unseen_in_joints(self) -> bool:
        """Whether joint positions say little of it: it acts on the body, or on another signal of the log."""
        return self.of_body or self.signal is not None or self.silent

    def unseen_in_joints_at(self, x: Mapping[str, float]) -> bool:
        """Whether joint positions say little of it at these coordinates: what they would show is within tolerance there."""
        beyond = {q.name for q in self.quantities if not q.shape and abs(x[q.name]) >= q.small}
        return self.unseen_in_joints or (bool(beyond) and beyond <= self.unseen)

    def of_sensors_at(self, x: Mapping[str, float]) -> bool:
        """Whether it acts on what sensors tell, and not on what moves, at these coordinates."""
        return self.signal is not None or (not self.of_body and not self.silent and self.unseen_in_joints_at(x))

    def values(self, x: Mapping[str, float], reference: Reference, joints: Ints) -> dict[str, float]:
        """The parameters at a point of the coordinates."""
        return {q.name: q.value(x[q.name], q.scale(reference, joints)) for q in self.quantities}

    def edges(self, reference: Reference, joints: Ints) -> list[dict[str, float]]:
        """Coordinates of robots at the edge of each of its tolerances, which differ in nothing else."""
        out = []
        for one in self.quantities:
            if one.tolerance > 0 and not one.shape:
                edge = {q.name: q.sought()[len(q.sought()) // 2] if q.shape else 0.0 for q in self.quantities}
                out.append({**edge, one.name: one.allowed(reference, joints)})
        return out

    def starts(self, strength: float, turn: int = 0, turns: int = 1) -> list[dict[str, float]]:
        """Coordinates of one size in every direction that matters: either sign, each part of a vector by itself.

        Args:
            turn, turns: of the levels of shapes, every `turns`-th is taken, from this one on.
        """
        out = []
        levels = [
            [(q.name, level) for level in q.sought()[turn::turns] or q.sought()] for q in self.quantities if q.shape
        ]
        for shapes in itertools.product(*levels):
            out += [{**one, **dict(shapes)} for one in self._directions(strength)]
        return out

    def _directions(self, strength: float) -> list[dict[str, float]]:
        sizes = [q for q in self.quantities if not q.shape]
        size = {q.name: q.small * (q.large / q.small) ** strength for q in sizes}
        out = []
        if self.vector:
            for one in sizes:
                for sign in (1.0, -1.0) if one.signed else (1.0,):
                    out.append({q.name: sign * size[q.name] if q is one else 0.0 for q in sizes})
            return out
        first = sizes[0]
        for sign in (1.0, -1.0) if first.signed else (1.0,):
            # What comes beside the first is nothing where it may have either sign.
            rest = {q.name: 0.0 if q.signed else size[q.name] for q in sizes[1:]}
            out.append({first.name: sign * size[first.name], **rest})
        return out


#: what an effect is to a diagnosis
Cause = Effect
