"""Two nodes of heat a servo, on arrays: the winding, which makes it, and the case, where the sensor sits.

    Cw · dTw/dt = P − Gw·(Tw − Tc)                       P = k·R(Tw)·I²,   R = R25·(1 + α·(Tw − 25))
    C  · dTc/dt = Gw·(Tw − Tc) + idle + λ·gear − G·r·(|r|/30 K)^n + g·(Tn − Tc),   r = Tc − Ta

Ta is the room, Tn the case of the neighbour in the leg, g what its bracket conducts. Free convection and radiation take
more than in proportion, hence n; G holds at 30 K. Where no current is measured, I = (d·V − ke·ω)/R from the duty d, so
that k·(d·V − ke·ω)²/R is lost: less when the winding is hot. `k` is what current sensor, data sheet and gear get wrong.

Each step is solved exactly for its linear part, so that no step is too long to be stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.thermal.inputs import Source

__all__ = ["AIR_RISE_K", "COPPER_PER_K", "ServoHeat", "State", "advance", "by_duty", "steady_drive", "winding_heat"]

Array = NDArray[np.float64]

#: 1/K, rise of copper's resistance about 25 °C
COPPER_PER_K = 0.0039
#: K over the room at which G holds
AIR_RISE_K = 30.0
#: K, below which the power law is cut: at no rise there is no flow, whatever the exponent
_LEAST_RISE_K = 0.5


@dataclass(frozen=True)
class ServoHeat:
    """Heat of the servos of one robot, b variants of it at once: arrays (b, joints), or (b, 1) where all share one.

    Attributes:
        case_j_k, air_w_k, winding_j_k, winding_w_k: C, G, Cw, Gw.
        scale: k. idle: of the electronics' nominal power. leg_w_k: g.
        room_c: Ta. exponent: n. gear: λ.
        resistance: (joints,) R25. by_duty: (joints,) whether the drive is (d·V)² instead of I². partner: (joints,)
            the neighbour's place, −1 for none.
    """

    case_j_k: Array
    air_w_k: Array
    winding_j_k: Array
    winding_w_k: Array
    scale: Array
    idle: Array
    leg_w_k: Array
    room_c: Array
    exponent: Array
    gear: Array
    resistance: Array
    by_duty: NDArray[np.bool_]
    partner: NDArray[np.intp]

    @cached_property
    def winding_tau_s(self) -> Array:
        """Cw / Gw."""
        return self.winding_j_k / self.winding_w_k

    @cached_property
    def leg(self) -> Array:
        """(b, joints) W/K to the neighbour, 0 where there is none."""
        return np.asarray(self.leg_w_k * (self.partner >= 0))


@dataclass(frozen=True)
class State:
    """(b, joints) °C each."""

    winding: Array
    case: Array


def by_duty(source: Sequence[Source]) -> NDArray[np.bool_]:
    """(joints,) whose drive is a voltage."""
    return np.array([one == "duty" for one in source])


def winding_heat(servos: ServoHeat, winding: Array, drive: Array) -> Array:
    """(b, joints) W made in the windings at (b, joints) °C by a drive, A² or V²; heat of unknown cause is W itself."""
    resistance = servos.resistance * (1 + COPPER_PER_K * (winding - 25.0))
    return servos.scale * drive * np.where(servos.by_duty, 1.0 / resistance, resistance)


def advance(
    servos: ServoHeat, state: State, seconds: float, drive: Array, gear: Array, idle: Array, room: Array | None = None
) -> State:
    """The state after `seconds` of constant drive (A² or V²), gear and idle power (W), each (joints,) or (b, joints).

    Args:
        room: (b, 1) °C, in place of the servos' own, for a room that changes.
    """
    room = servos.room_c if room is None else room
    power = winding_heat(servos, state.winding, drive)
    tau = servos.winding_tau_s
    fade = np.exp(-seconds / tau)
    goal = state.case + power / servos.winding_w_k
    away, faded = state.winding - goal, 1 - fade
    winding = goal + away * fade
    mean = goal + away * faded * tau / seconds
    flow = servos.winding_w_k * (mean - state.case)
    rise = np.maximum(np.abs(state.case - room), _LEAST_RISE_K)
    air = servos.air_w_k * (rise / AIR_RISE_K) ** servos.exponent
    # Who has no neighbour gives it nothing, whatever place -1 means.
    leg = servos.leg
    neighbour = state.case[:, servos.partner]
    out = air + leg
    gain = flow + servos.idle * idle + servos.gear * gear + air * room + leg * neighbour
    goal = gain / out
    case = goal + (state.case - goal) * np.exp(-seconds * out / servos.case_j_k)
    return State(winding + (case - state.case) * faded, case)


def steady_drive(servos: ServoHeat, case: Array, idle: Array, others: Array) -> Array:
    """(b, joints) the drive (A² or V²) that keeps a case at (joints,) °C for ever, its neighbour at (b, joints) °C.

    0 where it is warmer than that without any.
    """
    rise = np.maximum(case - servos.room_c, 0.0)
    air = servos.air_w_k * rise * (np.maximum(rise, _LEAST_RISE_K) / AIR_RISE_K) ** servos.exponent
    leg = servos.leg * (case - others[:, servos.partner])
    power = np.maximum(air + leg - servos.idle * idle, 0.0)
    winding = case + power / servos.winding_w_k
    resistance = servos.resistance * (1 + COPPER_PER_K * (winding - 25.0))
    return np.asarray(power / servos.scale * np.where(servos.by_duty, resistance, 1.0 / resistance))
