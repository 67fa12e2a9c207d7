"""What is wrong with each robot of a set, drawn from a seed: the answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from openant_tools.blind.sizes import KINDS, SIZES, STANDARD, Size
from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS

__all__ = ["BATCH", "BUS", "ELSEWHERE", "OUTSIDE", "Answer", "Drawn", "Mix", "draw_answers"]

Group = Literal["none", "single", "two", "outside"]
#: the two makers that live here, as answers name them; any other is a command
BATCH, BUS = "batch", "virtual"

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

#: More of the kind, which only commands are asked for.
ELSEWHERE: Mapping[str, str] = {
    "soft_gain": "a gain that depends on the angle",
    "command_prefilter": "the firmware smooths commands by a filter of second order",
    "spring_hysteresis": "a spring at a joint that gives back less than it takes",
    "tether": "a line to a hook above, which pulls once it is taut",
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
        maker: BATCH, BUS, or the command that makes it.
        tracker: whether its floor runs have `base.*`.
    """

    group: Group
    effects: tuple[Drawn, ...]
    seed: int
    maker: str
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


def draw_answers(count: int, seed: int, mix: Mix | None = None, maker: str | None = None) -> list[Answer]:
    """`count` robots; every effect of the catalogue in turn before one comes again.

    Args:
        maker: BATCH, BUS or a command for all of them: what it cannot make is not drawn. None: of the two that live here either.
    """
    mix = mix or Mix()
    if maker == BUS:
        mix = replace(mix, outside=0.0)
    chance = np.random.default_rng(seed)
    groups: list[Group] = []
    for group, share in (("none", mix.none), ("two", mix.two), ("outside", mix.outside)):
        groups += [group] * round(share * count)  # type: ignore[list-item]
    groups = groups[:count] + ["single"] * (count - len(groups))
    chance.shuffle(groups)
    names = tuple(name for name in KINDS if maker != BUS or name not in _BATCH_ONLY)
    singles = _deck(names, chance)
    strange = _deck((*OUTSIDE,) if maker in (None, BATCH, BUS) else (*OUTSIDE, *ELSEWHERE), chance)
    sizes = np.asarray(mix.sizes) / sum(mix.sizes)
    answers = []
    for number, group in enumerate(groups):
        answer = Answer(group, (), int(chance.integers(2**31)), maker or BATCH, bool(number % 2))
        if group == "single":
            size = SIZES[int(chance.choice(3, p=sizes))]
            name = next(singles)
            answer = replace(answer, effects=(_effect(name, size, chance, mix.widest),))
            while maker == BUS and _batch_only(answer.effects[0]):
                answer = replace(answer, effects=(_effect(name, size, chance, False),))
        elif group == "two":
            answer = replace(answer, effects=_pair(chance, mix.widest))
            while maker == BUS and any(map(_batch_only, answer.effects)):
                answer = replace(answer, effects=_pair(chance, mix.widest))
        elif group == "outside":
            answer = replace(answer, outside=next(strange), parameters=_outside(chance))
        if any(KINDS[drawn.effect].needs_tracker for drawn in answer.effects):
            answer = replace(answer, tracker=True)
        possible = not answer.outside and not any(map(_batch_only, answer.effects))
        if possible and chance.random() < mix.virtual and maker is None:
            answer = replace(answer, maker=BUS)
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
