"""Whether joints stand where they were sent: what holds still farther from its command than its servo's gain explains.

Judged only where the command has rested for a while, so that no motion is too fast for it: after a ramp, while a pose is
held, between the pieces of an excitation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.bus import Answer
from openant_tools.comms.guards import Trip
from openant_tools.comms.restart import StopCause
from openant_tools.comms.servos import Block, Servo
from openant_tools.numbers import number, percent

__all__ = ["REST_S", "Behind", "Following", "allowance"]

Array = NDArray[np.float64]

#: s for which a command must have rested: the slowest of soft servos (gain 50) is there within half of it
REST_S = 1.0
#: rad by which a command may creep and still rest
REST_RAD = 0.02
#: bit of Moving Status (123): a profile is under way
PROFILE = 0x02


@dataclass(frozen=True)
class Behind:
    """A joint that stands where it was not sent.

    Attributes:
        command_rad, angle_rad: where it should be, and where it is.
        duty: with how much of full duty it pushes.
    """

    servo: Servo
    command_rad: float
    angle_rad: float
    duty: float

    @property
    def trip(self) -> Trip:
        """Why the motion ends, as far as the joint's angle alone tells."""
        away = abs(self.command_rad - self.angle_rad)
        return Trip(
            f"{self.servo.called} stands {number(away, 'rad')} from its command: it was sent to "
            f"{number(self.command_rad, 'rad')}, is at {number(self.angle_rad, 'rad')} and pushes with {percent(abs(self.duty))} of full duty",
            "blocked, overloaded or weak: free the joint, take load off it, and look at its horn and its supply",
            self.servo.joint,
            "behind",
            StopCause.NOT_FOLLOWING,
        )


def allowance(servo: Servo, p_gain: float | None, least_rad: float) -> float:
    """rad that a healthy joint may stand from its command: what its gain gives way under all that its servo is made to bear
    for long, which weight, load and friction must stay below."""
    stiffness = servo.model.stiffness_nm_rad(p_gain)
    return max(least_rad, servo.model.nominal_torque_nm / stiffness) if stiffness > 0 else np.inf


@dataclass
class Following:
    """The joints of one robot over time.

    Attributes:
        least_rad: rad below which nobody is behind; see `Guards.behind_rad`.
        registers: joint → settings in force.
    """

    servos: Sequence[Servo]
    least_rad: float
    registers: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rests_at = np.full(len(self.servos), np.nan)
        self._since = np.zeros(len(self.servos))
        self.take(self.registers)

    def take(self, registers: Mapping[str, Mapping[str, int]]) -> None:
        """Settings in force from here on."""
        gains = [registers.get(servo.joint, {}).get("position_p_gain") for servo in self.servos]
        self._allowed = np.array(
            [allowance(servo, gain, self.least_rad) for servo, gain in zip(self.servos, gains, strict=True)]
        )

    def reset(self) -> None:
        """What was commanded before does not count: torque came on, or a joint was let go."""
        self._rests_at[:] = np.nan

    def check(
        self, t: float, goal: Array, loose: NDArray[np.bool_], answers: Sequence[tuple[Answer, Block | None]]
    ) -> tuple[bool, Behind | None]:
        """Whether all joints are near their commands, and the first that has stood away from it for too long.

        Args:
            t: s. goal: (n,) rad, as commanded. loose: (n,), whose torque is off. answers: of this cycle.
        """
        with np.errstate(invalid="ignore"):
            moved = ~(np.abs(goal - self._rests_at) <= REST_RAD) | loose
        self._rests_at[moved], self._since[moved] = goal[moved], t
        near = True
        for k, (servo, (_, block)) in enumerate(zip(self.servos, answers, strict=True)):
            if block is None or loose[k]:
                continue
            angle = servo.to_joint(block.position * servo.model.registers["present_position"].scale)
            if abs(goal[k] - angle) <= self._allowed[k]:
                continue
            near = False
            if t - self._since[k] >= REST_S and not block.moving_status & PROFILE:
                duty = servo.model.registers["present_pwm"].to_si(block.pwm)
                return False, Behind(servo, float(goal[k]), angle, duty)
        return near, None
