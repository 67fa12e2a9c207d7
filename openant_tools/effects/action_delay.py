"""Commands act later than they were sent."""

from __future__ import annotations

import mujoco

from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.effects.servo_form import servo
from openant_tools.model.plant import LONGEST_DELAY_S, Plant

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.delay[joints] += values["delay_s"]


def _read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.actuator_delay[plant.actuator[j]])


def _ignore(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    """Nothing in the model: a rollout takes delays beside it (`delays`), a written model in its buffers (`buffered`)."""


effect = Effect(
    name="action_delay",
    family="timing",
    words="commands act later than they were sent",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("delay_s", "s", 0.003, 0.06, tolerance=0.002),),
    enter=_enter,
    native=True,
    writer=servo,
    kinds=(
        # A loop of 50 Hz may act a period late.
        Kind(
            "action_delay",
            "s",
            _read,
            _ignore,
            None,
            lambda limit: 0.02,
            high=LONGEST_DELAY_S,
            shown_by="`steps`",
            told_from={
                "actuator_lag": "`steps` and `square`: a delay shifts an edge, a lag rounds it",
                "damping": "`chirp` and `steps`: a delay grows with frequency where damping does not",
                "velocity_gain": "`chirp` and `steps`: a delay grows with frequency where damping does not",
                "armature": "`steps`: inertia shows in the overshoot, a delay in the start",
            },
        ),
    ),
    told_from={
        "sensor_delay": Action(
            "tap the robot",
            "hold it still, tap a leg sharply and log current or the IMU beside positions: what comes late "
            "without any command is the sensor",
        )
    },
)
