"""What is wrong with each robot of a set, drawn from a seed: the answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from openant_tools.blind.sizes import KINDS, SIZES, STANDARD, Size
from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS

__all__ = ["OUTSIDE", "Answer", "Drawn", "Mix", "draw_answers"]

Group = Literal["none", "single", "two", "outside"]
Maker = Literal["batch", "virtual"]

#: What the catalogue has no name for, in words for the report.
OUTSIDE: Mapping[str, str] = {
    "mount_resonance": "the leg's mount swings on the torso",
    "slipping_horn": "the horn slips on its shaft under load",
    "chipped_tooth": "a chipped tooth: play and a bump at some angles of the gear",
    "long_leg": "a lower leg longer than the others",
    "lost_foot": "the foot came off: a shorter, thinner, lighter leg",
    "rubber_band": "something elastic between two legs",
    "loose_battery": "a mass that slides to and fro in the torso",
    "uneven_floor": "one foot stands on a slab",
    "forgotten_integral": "an integral gain left in the servos",
    "eccentric_encoder": "the encoder's magnet is off its axis",
}

#: Effects that the batch simulator has to make: the virtual robot gives them another form (speed_limit brakes always,
#: viscous_nonlinear replaces the linear part), or its host samples without delay.
_BATCH_ONLY = frozenset({"speed_limit", "viscous_nonlinear", "tracker_scale"})
#: Pairs that no record tells apart, or that are one fault told twice.
_TWINS = (
    {"action_delay", "sensor_delay"}, {"stiffness_error", "weak_joint"}, {"coulomb_friction", "stribeck_friction"},
    {"coulomb_friction", "asymmetric_friction"}, {"stribeck_friction", "asymmetric_friction"},
    {"damping_error", "viscous_nonlinear"}, {"damping_error", "electrical_damping"}, {"backlash", "joint_compliance"},
    {"torque_limit", "weak_joint"}, {"torque_limit", "speed_limit"},
)  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """One effect of one robot; `joints` as a diagnosis names them."""

    effect: str
    joints: tuple[str, ...] | str
    parameters: Mapping[str, Any]
    size: Size

    @property
    def family(self) -> str:
        return KINDS[self.effect].family


@dataclass(frozen=True)
class Answer:
    """What is true of one robot.

    Attributes:
        effects: of the catalogue. outside: a name of OUTSIDE, with its joint and strength in `parameters`.
        seed: of its scatter, sensors and clocks.
        maker: which of the two simulators makes it.
        tracker: whether its floor runs have `base.*`.
    """

    group: Group
    effects: tuple[Drawn, ...]
    seed: int
    maker: Maker
    tracker: bool
    outside: str | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The name that a diagnosis ought to say first; of two effects either."""
        return self.effects[0].effect if self.effects else "unexplained" if self.outside else "none"

    def as_table(self) -> dict[str, Any]:
        """For TOML."""
        table: dict[str, Any] = {
            "group": self.group, "verdict": self.verdict, "maker": self.maker, "tracker": self.tracker, "seed": self.seed,
        }  # fmt: skip
        if self.outside:
            table["outside"], table["parameters"] = self.outside, dict(self.parameters)
        table["effect"] = [
            {
                "effect": drawn.effect,
                "joints": drawn.joints if isinstance(drawn.joints, str) else list(drawn.joints),
                "size": drawn.size,
                "parameters": dict(drawn.parameters),
            }
            for drawn in self.effects
        ]
        return table

    @classmethod
    def of(cls, table: Mapping[str, Any]) -> Answer:
        """From what `as_table` gives."""
        effects = tuple(
            Drawn(
                one["effect"], one["joints"] if isinstance(one["joints"], str) else tuple(one["joints"]),
                dict(one["parameters"]), one["size"],
            )
            for one in table["effect"]
        )  # fmt: skip
        return cls(
            table["group"], effects, table["seed"], table["maker"], table["tracker"], table.get("outside"),
            dict(table.get("parameters", {})),
        )  # fmt: skip


@dataclass(frozen=True)
class Mix:
    """How a set is made up, as shares of its robots; the rest has one effect.

    Attributes:
        sizes: shares of small, medium and large among the robots with one effect.
        virtual: share of the robots that come from the virtual robot's bus, of those whose effect it can have.
        widest: each effect at as many joints as it may belong to, not at one joint of eight.
    """

    none: float = 0.35
    two: float = 0.15
    outside: float = 0.12
    sizes: tuple[float, float, float] = (0.25, 0.4, 0.35)
    virtual: float = 0.5
    widest: bool = False

    def __post_init__(self) -> None:
        shares = (self.none, self.two, self.outside)
        if min(*shares, *self.sizes) < 0 or sum(shares) > 1 + 1e-9 or not 0 <= self.virtual <= 1:
            raise BadInput("the shares of a set lie between 0 and 1, and together at most at 1", remedy="change --mix")


def draw_answers(count: int, seed: int, mix: Mix | None = None) -> list[Answer]:
    """`count` robots; every effect of the catalogue in turn before one comes again."""
    mix = mix or Mix()
    chance = np.random.default_rng(seed)
    groups: list[Group] = []
    for group, share in (("none", mix.none), ("two", mix.two), ("outside", mix.outside)):
        groups += [group] * round(share * count)  # type: ignore[list-item]
    groups = groups[:count] + ["single"] * (count - len(groups))
    chance.shuffle(groups)
    singles, strange = _deck(tuple(KINDS), chance), _deck(tuple(OUTSIDE), chance)
    sizes = np.asarray(mix.sizes) / sum(mix.sizes)
    answers = []
    for number, group in enumerate(groups):
        answer = Answer(group, (), int(chance.integers(2**31)), "batch", bool(number % 2))
        if group == "single":
            size = SIZES[int(chance.choice(3, p=sizes))]
            answer = replace(answer, effects=(_effect(next(singles), size, chance, mix.widest),))
        elif group == "two":
            answer = replace(answer, effects=_pair(chance, mix.widest))
        elif group == "outside":
            name = next(strange)
            answer = replace(answer, outside=name, parameters=_outside(chance))
        if any(KINDS[drawn.effect].needs_tracker for drawn in answer.effects):
            answer = replace(answer, tracker=True)
        possible = not answer.outside and not any(_batch_only(drawn) for drawn in answer.effects)
        if possible and chance.random() < mix.virtual:
            answer = replace(answer, maker="virtual")
        answers.append(answer)
    return answers


def _batch_only(drawn: Drawn) -> bool:
    return drawn.effect in _BATCH_ONLY or (drawn.effect == "sensor_delay" and drawn.joints == "body")


def _deck(names: Sequence[str], chance: np.random.Generator) -> Any:
    """Names without end, each once before any comes again."""
    while True:
        for k in chance.permutation(len(names)):
            yield names[k]


def _effect(name: str, size: Size, chance: np.random.Generator, widest: bool) -> Drawn:
    kind = KINDS[name]
    scope = str(chance.choice(list(kind.scopes)))
    if widest:
        scope = max(kind.scopes, key="jbga".index)
    joints: tuple[str, ...]
    if scope == "j":
        joints = (str(chance.choice(kind.joints)),)
    elif scope == "g":
        model = ("hip", "knee")[int(chance.integers(2))]
        joints = tuple(joint.name for joint in JOINTS.values() if joint.kind == model)
    else:
        joints = tuple(JOINTS)
    parameters = kind.draw(SIZES.index(size), chance, joints, STANDARD)
    return Drawn(name, joints if scope in "jg" else "all" if scope == "a" else "body", parameters, size)


def _pair(chance: np.random.Generator, widest: bool) -> tuple[Drawn, ...]:
    while True:
        first, second = (str(name) for name in chance.choice(list(KINDS), 2, replace=False))
        if {first, second} not in _TWINS:
            break
    sizes: list[Size] = ["medium", "large"]
    return tuple(_effect(name, sizes[int(chance.integers(2))], chance, widest) for name in (first, second))


def _outside(chance: np.random.Generator) -> dict[str, Any]:
    return {"joint": str(chance.choice(list(JOINTS))), "strength": float(chance.uniform(0.6, 1.4))}
