"""A torque that repeats with the joint's angle: magnets, or a bad tooth."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount, shape, usual_torque
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step

__all__ = ["effect"]

#: where no number is given
USUAL_PERIODS = 12.0


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("cogging", "amplitude_nm")[joints] += values["amplitude_nm"]
    robot.law("cogging", "periods")[joints] = values["periods"]


def _law(values: Table) -> Law:
    amplitude = values["amplitude_nm"]
    periods = np.where(values["periods"] > 0, values["periods"], USUAL_PERIODS)

    def act(step: Step) -> None:
        step.torque += amplitude * np.sin(periods * step.position)

    return act


def _write(document: Document, j: int) -> None:
    amplitude, periods = (document.law("cogging", name, j) for name in ("amplitude_nm", "periods"))
    if amplitude:
        # It repeats with the gear's own angle, which the encoder reads with its zero.
        document.gear(j, "cogging", "cogging", [amplitude, periods, -periods * float(document.robot.zero[j])])


effect = Effect(
    name="cogging",
    family="transmission",
    words="a torque repeats with the joint's angle",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("amplitude_nm", "N·m", 0.03, 0.4, scale=usual_torque),
        shape("periods", "1", 6.0, 40.0, levels=12),
    ),
    enter=_enter,
    native=True,
    writer=Writer(32, joint=_write),
    law=_law,
    order=25,
    parameters=(Parameter("amplitude_nm", "N·m", 0.05), Parameter("periods", "per turn", 12.0, high=2000.0)),
)
