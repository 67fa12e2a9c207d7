"""The model as data sheet and registers would have it: what a builder knows before any fit."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import mujoco

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant
from openant_tools.recording.run import Run
from openant_tools.robot.gain_models import GainModel, Registers, gain_model
from openant_tools.robot.servo_gains import to_mjcf
from openant_tools.sysid.kinds import KINDS

__all__ = ["data_sheet_model"]


def data_sheet_model(plant: Plant, runs: Sequence[Run]) -> mujoco.MjModel | None:
    """A copy of the plant's model with the servos that the runs name as their maker describes them.

    Stiffness, damping, velocity gain (where the model has one) and torque limit are what the registers give at the runs' supply
    (`servo_gains.to_mjcf`). Registers that the runs do not tell are the factory's, and so is the supply. Inertia, friction, delay and
    joints whose servo is unknown stay as given: no data sheet states them.

    Returns:
        None where the runs name no servo that is known.
    """
    model, known = copy.copy(plant.model), False
    for j, joint in enumerate(plant.joints):
        servo, facts = next(((one, run.facts) for run in runs if (one := _servo(run, joint))), (None, None))
        if servo is None or facts is None:
            continue
        known = True
        # Where the given model has its damping, there it stays: in the servo, or in the joint.
        in_servo = KINDS["velocity_gain"].read(plant.model, plant, j) > 0
        in_joint = KINDS["damping"].read(plant.model, plant, j) > 0 or not in_servo
        registers = _registers(servo, facts.registers.get(joint, {}))
        supply = servo.nominal_voltage_v if facts.supply_v is None else facts.supply_v
        mjcf = to_mjcf(servo, registers, supply, "joint" if in_joint else "kv")
        KINDS["stiffness"].write(model, plant, j, mjcf.kp)
        KINDS["torque_limit"].write(model, plant, j, mjcf.force_nm)
        if in_servo:
            KINDS["velocity_gain"].write(model, plant, j, mjcf.kv)
        if in_joint:
            KINDS["damping"].write(model, plant, j, mjcf.damping)
    return model if known else None


def _servo(run: Run, joint: str) -> GainModel | None:
    """The servo that drives a joint, where a data sheet of it is here."""
    try:
        return gain_model(run.facts.motors.get(joint, ""))
    except BadInput:
        return None


def _registers(servo: GainModel, read: Mapping[str, float]) -> Registers:
    """What was read of the servo's registers, else what it is delivered with."""
    names = {"position_p": "position_p_gain", "position_i": "position_i_gain", "position_d": "position_d_gain"}
    factory = asdict(servo.factory)
    return Registers(**{name: round(read.get(names.get(name, name), count)) for name, count in factory.items()})
