"""How robots of one build differ (effects.md): within this a re-fitted model is calibrated, beyond it lies an effect."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import USUAL_NOISE, Form, Reference, Robot

__all__ = ["FACTORS", "FLOOR", "random_form", "scatter", "tolerance_of", "torso_kg"]

Array = NDArray[np.float64]


def tolerance_of(effect: str, quantity: str | None = None) -> float:
    """Within what robots of one build differ, as it stands with the effect: of its first quantity, or the one named."""
    found = catalogue()[effect]
    return (found.quantities[0] if quantity is None else found.quantity(quantity)).tolerance


#: kind → how far the logarithm of a robot's factor may lie from 0
FACTORS = {
    "stiffness": tolerance_of("stiffness_error"),
    "torque_limit": tolerance_of("torque_limit"),
    "damping": tolerance_of("damping_error"),
    "armature": tolerance_of("armature_error"),
    "link_mass": tolerance_of("link_mass"),
}
#: the same of the floor's contacts; of what only says how their simulation is made, how far it is from any contact's
FLOOR = {
    "floor_friction": tolerance_of("floor_friction"), "softness": tolerance_of("contact_softness"), "contact_damping": 0.4,
    "contact_give": 0.6, "contact_depth": 0.6, "impratio": math.log(10.0),
}  # fmt: skip
#: share of its length by which a link may be longer
LENGTH = 0.01
#: of the torso mass's tolerance on a robot that is not an Ant: share of its mass
TORSO_SHARE = 0.03
#: share by which a current or load sensor's scale is uncertain
TORQUE_SCALE = 0.03
#: share of its usual size by which a current sensor may be off at no torque
TORQUE_ZERO = 0.06
#: s by which a row's stamp is off its samples at most
STAMP_S = 0.0015
#: s, deviation of when a row is read about its stamp, on the worst healthy robot: hosts are no clocks
ROW_S = 0.001
#: s by which low-pass filters make an accelerometer later than a gyroscope at most (Betaflight's is 10 to 25 Hz)
ACC_LATE_S = 0.010
#: steps of a voltage sensor between which the supply may lie: which of its steps is nearest is a matter of chance
VOLT_BETWEEN = 0.5
#: logarithms of factors on what a contact is like beside its softness
CONTACT_DAMPING, CONTACT_FORM = (-0.4, 0.15), (-0.9, 0.6)
#: logarithms between which a sensor's noise lies, as a factor on the usual: nobody says how good a sensor is
NOISE = (-1.8, 0.5)


def scatter(robot: Robot, reference: Reference, rng: np.random.Generator, width: float = 1.0) -> None:
    """Make a robot differ as robots of one build do.

    Args:
        width: of what is drawn, in tolerances: a judge that has seen a little more is not surprised at the edge.
    """
    n = robot.joints

    def spread(size: int = n) -> Array:
        # Servos of one batch have much in common; how much is not known.
        common, share = rng.uniform(-1, 1), rng.uniform(0, 1)
        both: Array = width * (share * common + (1 - share) * rng.uniform(-1, 1, size))
        return both

    for kind, tolerance in FACTORS.items():
        robot.factor(kind)[:] *= np.exp(tolerance * spread())
    # Where the model has almost no friction it has as little to lose.
    robot.more("coulomb_friction")[:] += (
        tolerance_of("coulomb_friction") * np.minimum(1.0, reference.torque / 0.2) * spread()
    )
    robot.zero += width * tolerance_of("zero_offset") * rng.uniform(-1, 1, n)
    robot.delay += tolerance_of("action_delay") * spread()
    robot.electrical += float(rng.uniform(0, tolerance_of("electrical_damping")))
    robot.length *= 1 + width * LENGTH * rng.uniform(-1, 1, n)
    robot.law("voltage_sag", "resistance_ohm")[:] += float(rng.uniform(0, tolerance_of("voltage_sag")))
    robot.torso_kg += width * rng.uniform(-1, 1) * torso_kg(reference)
    robot.floor_friction *= math.exp(width * FLOOR["floor_friction"] * rng.uniform(-1, 1))
    robot.softness *= math.exp(width * FLOOR["softness"] * rng.uniform(-1, 1))
    robot.tilt += width * tolerance_of("floor_tilt") * rng.uniform(-1, 1, 2) / math.sqrt(2)
    robot.imu_rotation += width * tolerance_of("imu_misalignment") * rng.uniform(-1, 1, 3)
    robot.gyro_bias += width * tolerance_of("imu_bias", "gyro_x") * rng.uniform(-1, 1, 3)
    robot.acc_bias += width * tolerance_of("imu_bias", "acc_x") * rng.uniform(-1, 1, 3)
    # A servo's velocity register is a filtered one, and stamps are not exactly those of the samples.
    robot.log_delay["vel"] = robot.log_delay.get("vel", 0.0) + float(
        rng.uniform(0, tolerance_of("sensor_delay", "vel"))
    )
    robot.log_delay["imu"] = robot.log_delay.get("imu", 0.0) + float(
        rng.uniform(0, tolerance_of("sensor_delay", "imu"))
    )
    robot.log_delay["acc"] = float(rng.uniform(0, ACC_LATE_S))
    stamp = float(rng.uniform(-STAMP_S, STAMP_S))
    for signal in ("pos", "vel", "torque"):
        robot.log_delay[signal] = robot.log_delay.get(signal, 0.0) + stamp
    for signal, noise in USUAL_NOISE.items():
        robot.noise[signal] = noise * float(np.exp(rng.uniform(*NOISE)))
    robot.noise["stamp"] = float(rng.uniform(0, ROW_S))
    robot.noise["volt_between"] = float(rng.uniform(-VOLT_BETWEEN, VOLT_BETWEEN))
    robot.noise["torque_zero"] = float(TORQUE_ZERO * rng.uniform(0, 1))
    robot.noise["torque_scale"] = float(np.exp(TORQUE_SCALE * rng.normal()))


def torso_kg(reference: Reference) -> float:
    """How far from the model a torso's mass may be."""
    return min(tolerance_of("payload"), TORSO_SHARE * reference.robot_kg)


def random_form(rng: np.random.Generator, encoder_rad: float) -> Form:
    """A numerical form at random: what names a cause in one only would name it wrongly on a robot."""
    pyramidal = rng.random() < 0.2
    impratio = float(np.exp(rng.uniform(0.0, math.log(30.0)))) if not pyramidal else float(rng.choice([1.0, 3.0, 10.0]))
    integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST if rng.random() < 0.6 else mujoco.mjtIntegrator.mjINT_IMPLICIT
    friction = rng.random()
    smooth = float(np.exp(rng.uniform(math.log(0.02), math.log(0.1)))) if friction < 0.2 else 0.0
    bristle = float(np.exp(rng.uniform(math.log(1e-4), math.log(3e-3)))) if friction > 0.6 else 0.0
    return Form(
        int(integrator), not pyramidal, impratio, smooth, bristle,
        encoder_rad=encoder_rad if rng.random() < 0.7 else 0.0,
        contact_damping=math.exp(rng.uniform(*CONTACT_DAMPING)),
        contact_give=math.exp(rng.uniform(*CONTACT_FORM)),
        contact_depth=math.exp(rng.uniform(*CONTACT_FORM)),
        loop_behind=bool(rng.random() < 0.9),
        tells_duty=bool(rng.random() < 0.5),
        tells_asked=bool(rng.random() < 0.5),
        one_packet=bool(rng.random() < 0.6),
        never_early=bool(rng.random() < 0.4),
    )  # fmt: skip
