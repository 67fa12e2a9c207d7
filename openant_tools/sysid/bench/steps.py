"""The bench's procedures by themselves, as steps of any face: each asks for what its command takes as options."""

from __future__ import annotations

import math

from openant_tools.calib.wires import engine_config
from openant_tools.errors import BadInput
from openant_tools.procedure.step import Ask, Bench, Procedure, Say, Subroutine
from openant_tools.procedure.unfinished import Parts, unfinished
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.sysid.bench import scale, tilt
from openant_tools.sysid.bench.friction import STEEPEST_RAD, Slope, friction_finding
from openant_tools.sysid.bench.knee_torque import torque_table
from openant_tools.sysid.bench.stiffness import Lever

__all__ = ["floor_friction", "knee_torque", "stiffness"]

SCALE, STOP = "a kitchen scale", "something that does not give"
IMU, PROTRACTOR = "the robot's own accelerometer", "a protractor"
TRIALS = 5


def knee_torque(bench: Bench) -> Procedure:
    """What the knees must bear against what their servos hold."""
    config = bench.folder.config()
    kit = kit_by_name(config.kit)
    mass = yield Ask("What does the whole robot weigh?", unit="kg", default=kit.total_mass_kg, low=0.1, high=20.0)
    return torque_table(kit, config, mass_kg=_number(mass, kit.total_mass_kg), command="openant sysid torque")


def stiffness(bench: Bench) -> Procedure:
    """One joint's stiffness, by the servo's own duty and by a kitchen scale.

    Raises:
        BadInput, HardwareFault: as `scale.stiffness`.
    """
    config = engine_config(bench)
    joints = sorted((servo.joint for servo in config.servos), key=lambda joint: joint.startswith("hip"))
    joint = str((yield Ask("Whose stiffness? A knee presses its foot down.", tuple(joints), default=joints[0])))
    kind = JOINTS[joint].kind if joint in JOINTS else "knee"
    arm = None
    if kind == "hip":
        arm = _number((yield Ask("How far is the hook from the hip's axis?", unit="m", low=0.02, high=0.5)), math.nan)
    by = yield Ask("What will hold the foot?", (SCALE, STOP), default=STOP)
    pressing = scale.Pressing(joint, HOME_RAD[kind], direction=1 if kind == "hip" else -1)
    lever = Lever(joint, measured_m=arm)
    return (yield from scale.stiffness(config, pressing, lever, weigh=by == SCALE, command="openant sysid scale"))


def floor_friction(bench: Bench) -> Procedure:
    """The floor's friction on a tilted plate, its angle read by the robot or by a protractor.

    Raises:
        BadInput, HardwareFault: as `tilt.floor_friction`.
    """
    command, name = "openant sysid tilt", "floor-friction"
    left = unfinished(bench.folder, name, virtual=bench.virtual)
    by = IMU if left else (yield Ask("What reads the plate's angle?", (IMU, PROTRACTOR), default=IMU))
    if by == IMU:
        trials = (
            (yield Ask("How often?", unit="trials", default=float(TRIALS), low=1, high=50)) if left is None else None
        )
        of = left.of if left else [f"trial {k + 1}" for k in range(int(_number(trials, TRIALS)))]
        parts = Parts(bench, name, of)
        if parts.before:
            yield Say(parts.words)
        found = yield from tilt.floor_friction(engine_config(bench), len(of), command=command, parts=parts)
        parts.end()
        return found
    slopes = [Slope(angle, "static") for angle in (yield from _angles("it began to slide"))]
    slopes += [Slope(angle, "kinetic") for angle in (yield from _angles("it kept sliding after a tap"))]
    if not slopes:
        raise BadInput(
            "no angle was read", remedy="tilt the plate until the robot slides, and read its angle from level"
        )
    return friction_finding(slopes, command, source="protractor")


def _angles(what: str) -> Subroutine[list[float]]:
    """Angles (rad), as often as the builder has read one."""
    found: list[float] = []
    while len(found) < TRIALS:
        words = f"At which angle {what}? Reading {len(found) + 1} of {TRIALS}; 0 where there is no more."
        degrees = yield Ask(words, unit="°", default=0.0, low=0.0, high=math.floor(math.degrees(STEEPEST_RAD)))
        if not _number(degrees, 0.0):
            break
        found.append(math.radians(_number(degrees, 0.0)))
    return found


def _number(answer: object, otherwise: float) -> float:
    return float(answer) if isinstance(answer, int | float) else otherwise
