"""The model as data sheet and registers would have it: what a builder knows before any fit."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco

from openant_tools.model.plant import Plant
from openant_tools.recording.run import Run
from openant_tools.robot.servo import PWM_FULL, SERVO_MODELS
from openant_tools.sysid.kinds import KINDS

__all__ = ["data_sheet_model"]


def data_sheet_model(plant: Plant, runs: Sequence[Run]) -> mujoco.MjModel | None:
    """A copy of the plant's model with the servos that the runs name as their maker describes them.

    Stiffness is P gain over divisor times stall torque, damping the slope of the torque–speed line, velocity gain (where the
    model has one) that of the D gain, and the torque limit stall torque times PWM limit, all at the runs' supply
    (`ServoModel`). Registers that the runs do not tell are the factory's. Inertia, friction, delay and joints whose servo is
    unknown stay as given: no data sheet states them.

    Returns:
        None where the runs name no servo that is known.
    """
    model, known = copy.copy(plant.model), False
    for j, joint in enumerate(plant.joints):
        facts = next((run.facts for run in runs if run.facts.motors.get(joint) in SERVO_MODELS), None)
        if facts is None:
            continue
        known = True
        servo, registers = SERVO_MODELS[facts.motors[joint]], facts.registers.get(joint, {})
        duty = registers.get("pwm_limit", PWM_FULL) / PWM_FULL
        KINDS["stiffness"].write(
            model, plant, j, servo.stiffness_nm_rad(registers.get("position_p_gain"), facts.supply_v)
        )
        # Where the given model has its damping, there it stays: in the servo, or in the joint.
        in_joint = KINDS["damping"].read(plant.model, plant, j) > 0
        in_servo = KINDS["velocity_gain"].read(plant.model, plant, j) > 0
        slope = servo.electrical_damping_nm_s_rad
        if in_servo:
            gain = servo.derivative_damping_nm_s_rad(registers.get("position_d_gain"), facts.supply_v)
            KINDS["velocity_gain"].write(model, plant, j, gain if in_joint else gain + slope)
        if in_joint or not in_servo:
            KINDS["damping"].write(model, plant, j, slope)
        KINDS["torque_limit"].write(model, plant, j, servo.stall_torque_at(facts.supply_v, duty))
    return model if known else None
