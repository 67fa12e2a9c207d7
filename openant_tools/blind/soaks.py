"""Soaks for the blind check of dropout attribution: what is drawn, and the answer that is sealed.

Two makers, of other code than the diagnosis and than each other: `tables` writes the columns by forms of its own
(`soak_tables`), `virtual` asks the virtual robot's bus transaction by transaction while it moves (`soak_virtual`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from openant_tools.numbers import stored
from openant_tools.robot.joints import JOINT_NAMES

__all__ = ["CAUSES", "LEGS", "SoakAnswer", "SoakMix", "draw_soaks"]

#: formats, section 7
CAUSES = (
    "power_connector", "supply_weak", "broken_wire", "bad_servo", "bad_cable", "line_noise", "return_delay",
    "latency_timer", "host_stall", "usb_unplug", "duplicate_id", "write_read_gap",
)  # fmt: skip
#: one cable a leg, hip first
LEGS = tuple((f"hip_{leg}", f"knee_{leg}") for leg in ("rr", "fr", "fl", "rl"))
#: columns that a log may lack, unless its cause shows in nothing else
_DROPPABLE = ("rtt", "tick", "volt", "wake", "cmd_t", "cur", "load", "vel", "err", "temp", "cmd", "pwm")
_NEEDED: Mapping[str, tuple[str, ...]] = {
    "return_delay": ("rtt",),
    "latency_timer": ("rtt",),
    "host_stall": ("wake",),
    "write_read_gap": ("cmd_t",),
    "supply_weak": ("volt", "cur", "load"),
    "power_connector": ("volt", "tick"),
    "usb_unplug": ("err",),
    "line_noise": ("err",),
    "duplicate_id": ("err",),
}


@dataclass(frozen=True)
class SoakMix:
    """Shares of what is drawn.

    Attributes:
        healthy: soaks with nothing wrong. virtual: of all, those of the virtual robot's bus.
        healthy_s, faulty_s: shortest and longest, s.
    """

    healthy: float = 1 / 3
    virtual: float = 0.25
    healthy_s: tuple[float, float] = (600.0, 900.0)
    faulty_s: tuple[float, float] = (120.0, 600.0)


@dataclass(frozen=True)
class SoakAnswer:
    """One soak and what is wrong in it.

    Attributes:
        cause: as in formats, section 7, or "none".
        where: joints; empty for the whole bus.
        maker: "tables" or "virtual".
        dropped: signals that the log lacks. joints: those that it has.
        chain: how the servos are wired; told in the facts where `chain_told`.
    """

    cause: str
    where: tuple[str, ...]
    seed: int
    maker: str
    seconds: float
    rate_hz: float
    baud: int
    dropped: tuple[str, ...] = ()
    joints: tuple[str, ...] = JOINT_NAMES
    chain: tuple[tuple[str, ...], ...] = LEGS
    chain_told: bool = True
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def as_table(self) -> dict[str, Any]:
        table = asdict(self)
        for name in ("where", "dropped", "joints"):
            table[name] = list(table[name])
        table["chain"] = [list(cable) for cable in self.chain]
        return table

    @classmethod
    def of(cls, table: Mapping[str, Any]) -> SoakAnswer:
        """The inverse of `as_table`."""
        rest = dict(table)
        for name in ("where", "dropped", "joints"):
            rest[name] = tuple(rest[name])
        rest["chain"] = tuple(tuple(cable) for cable in rest["chain"])
        return cls(**rest)


def draw_soaks(count: int, seed: int, mix: SoakMix | None = None) -> list[SoakAnswer]:
    """`count` soaks: the healthy share, and every cause in turn."""
    mix = mix or SoakMix()
    chance = np.random.default_rng([seed, 15])
    healthy = round(mix.healthy * count)
    causes = ["none"] * healthy + [CAUSES[k % len(CAUSES)] for k in range(count - healthy)]
    chance.shuffle(causes)
    return [_draw(cause, chance, mix) for cause in causes]


def _draw(cause: str, chance: np.random.Generator, mix: SoakMix) -> SoakAnswer:
    maker = "virtual" if chance.random() < mix.virtual else "tables"
    low, high = mix.healthy_s if cause == "none" else mix.faulty_s
    if maker == "virtual" and cause != "none":
        high = low + (high - low) / 3  # physics takes its time
    seconds = float(np.round(chance.uniform(low, high)))
    if maker == "virtual" and cause == "none":
        seconds = low
    rate = float(chance.choice([10.0, 20.0, 25.0, 50.0] if maker == "virtual" else [10.0, 20.0, 50.0, 100.0]))
    chain = LEGS if chance.random() < 0.7 else (JOINT_NAMES,)
    joints = JOINT_NAMES
    if maker == "tables" and chance.random() < 0.12:
        kept = sorted(chance.choice(4, size=int(chance.integers(2, 4)), replace=False).tolist())
        joints = tuple(name for k in kept for name in LEGS[k])
    chain = (joints,) if chain is not LEGS else tuple(cable for cable in LEGS if cable[0] in joints)
    needed = _NEEDED.get(cause, ())
    dropped = tuple(name for name in _DROPPABLE if name not in needed and chance.random() < 0.12)
    where = _where(cause, chance, joints, chain)
    return SoakAnswer(
        cause=cause,
        where=where,
        seed=int(chance.integers(2**31)),
        maker=maker,
        seconds=seconds,
        rate_hz=rate,
        baud=int(chance.choice([1_000_000, 1_000_000, 2_000_000, 57_600 if rate <= 10 else 1_000_000])),
        dropped=dropped,
        joints=joints,
        chain=chain,
        chain_told=bool(chance.random() < 0.8) or chain != LEGS,
        parameters=_parameters(cause, maker, chance),
    )


def _where(
    cause: str, chance: np.random.Generator, joints: Sequence[str], chain: Sequence[Sequence[str]]
) -> tuple[str, ...]:
    if cause in ("bad_servo", "broken_wire"):
        return (str(chance.choice(joints)),)
    if cause == "bad_cable":
        # With nothing but one servo behind it a cable cannot be told from that servo: two and more hang behind these.
        places = [name for cable in chain for name in cable[: len(cable) - 1]]
        if len(chain) == 1:
            places = places[1:]
        return (str(chance.choice(places or joints)),)
    if cause == "duplicate_id":
        return tuple(str(name) for name in chance.choice(joints, size=2, replace=False))
    if cause == "power_connector" and chance.random() < 0.25:
        places = [cable[0] for cable in chain]
        return (str(chance.choice(places)),)
    return ()


def _between(chance: np.random.Generator, low: float, high: float) -> float:
    """Evenly over the logarithm, to four digits."""
    return stored(np.exp(chance.uniform(np.log(low), np.log(high))), 4)


def _parameters(cause: str, maker: str, chance: np.random.Generator) -> dict[str, Any]:
    def u(low: float, high: float) -> float:
        return _between(chance, low, high)

    virtual = maker == "virtual"
    match cause:
        case "power_connector":
            if virtual:
                return {"openings_per_rad": u(0.01, 0.06), "open_s": u(0.03, 0.25)}
            return {
                "a_minute": u(0.7, 12),
                "open_s": u(0.015, 0.25),
                "by_motion": float(chance.choice([0.0, 1.0, 2.0])),
            }
        case "supply_weak":
            return {"resistance_ohm": u(2.5, 5.0)} if virtual else {"drop_v": u(1.0, 3.5), "share": u(0.004, 0.08)}
        case "broken_wire":
            return {"share": u(0.03, 0.4), "flicker": float(np.round(chance.uniform(0.0, 0.6), 2)),
                    "above": bool(chance.random() < 0.5)}  # fmt: skip
        case "bad_servo" | "bad_cable":
            return {"fraction": u(0.004, 0.3), "bursts": bool(chance.random() < 0.5), "broken": float(chance.random())}
        case "line_noise":
            return {"byte_error": u(3e-5, 3e-3)}
        case "return_delay":
            return {"delay_s": u(0.3e-3, 0.508e-3), "one": bool(chance.random() < 0.25)}
        case "latency_timer":
            return {"timer_s": 16e-3 if chance.random() < 0.85 else 8e-3, "locked": bool(chance.random() < 0.4),
                    "lossy": bool(chance.random() < 0.4)}  # fmt: skip
        case "host_stall":
            return {"every_s": u(1.0, 25.0), "for_s": u(0.05, 0.6), "periodic": bool(chance.random() < 0.4),
                    "lossy": bool(chance.random() < 0.4)}  # fmt: skip
        case "usb_unplug":
            return {"times": int(chance.integers(1, 4)), "for_s": u(0.5, 15.0), "word": bool(chance.random() < 0.75)}
        case "duplicate_id":
            return {"form": int(chance.integers(3)), "share": float(np.round(chance.uniform(0.55, 1.0), 2))}
        case "write_read_gap":
            return {"needed_s": u(0.2e-3, 1.2e-3), "form": int(chance.integers(2))}
    return {}
