"""What the host writes down of a simulated run: sampled, late, noisy, rounded as the sensors round."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from openant_tools.blind.commands import RATE_HZ, Motion
from openant_tools.blind.mechanics import STEP_S
from openant_tools.blind.robot import Senses, TrueRobot
from openant_tools.blind.simulate import Trace
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.control_table import AMPERE_PER_COUNT
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT_COUNTS, kit
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT

__all__ = ["RESOLUTION", "facts_of", "imu_columns", "logged", "tracker_columns"]

Array = NDArray[np.float64]

#: rad/s and m/s² a count of the IMU (±2000 °/s, ±16 g in 16 bits)
GYRO_COUNT, ACC_COUNT = math.radians(1 / 16.4), 9.80665 / 2048
#: Hz of the IMU's low-pass filters
GYRO_HZ, ACC_HZ = 100.0, 50.0
RESOLUTION = {
    "pos": RAD_PER_PULSE, "vel": RAD_S_PER_COUNT, "cur": AMPERE_PER_COUNT, "load": 1e-3, "pwm": 1 / PWM_FULL, "volt": 0.1,
    "temp": 1.0, "gyro": GYRO_COUNT, "acc": ACC_COUNT,
}  # fmt: skip


def facts_of(motion: Motion) -> Facts:
    """What anybody may know about a run of a set."""
    parts = kit("standard")
    models = {name: parts.servo(joint.kind) for name, joint in JOINTS.items()}
    return Facts(
        joints=tuple(JOINTS),
        motors={name: model.name for name, model in models.items()},
        setup=motion.setup,
        protocol=motion.protocol,
        registers={
            name: {
                "position_p_gain": float(model.register("position_p_gain").default or 0),
                "pwm_limit": PLATFORM_PWM_LIMIT_COUNTS,
            }
            for name, model in models.items()
        },
        heading_rad=motion.heading_rad if motion.setup == "floor" else None,
        supply_v=kit("standard").supply_v,
        resolution=RESOLUTION,
        extra={"held_out": motion.held_out, "rate_hz": RATE_HZ},
    )


def logged(robot: TrueRobot, motion: Motion, number: int, trace: Trace) -> Run:
    """The run table of one robot's `number`-th run."""
    chance = np.random.default_rng([robot.seed, number, 1])
    parts, senses, plan = kit("standard"), robot.senses, trace.plan
    at = plan.row + robot.clocks.sense_s - robot.clocks.sensor_s
    joints = list(JOINTS)

    def noisy(values: Array, deviation: float, count: float) -> Array:
        out: Array = np.rint((values + deviation * chance.standard_normal(values.shape)) / count) * count
        return out

    columns: dict[str, NDArray[Any]] = {}
    position = noisy(_between(trace.position, at), senses.encoder_rad, RAD_PER_PULSE)
    velocity = noisy(_between(trace.velocity, at), 0.0, RAD_S_PER_COUNT)
    last = np.clip((plan.row + robot.clocks.sense_s) / STEP_S, 0, len(trace.duty) - 1).astype(int)
    current = trace.current[last].astype(float)
    duty = np.rint(trace.duty[last] * PWM_FULL) / PWM_FULL
    volts = np.rint((trace.volts[last] + 0.03 * chance.standard_normal(len(last))) / 0.1) * 0.1
    share = np.linspace(0, 1, len(last))[:, None]
    case = np.floor(trace.case_c[0] + share * (trace.case_c[1] - trace.case_c[0]))
    for j, name in enumerate(joints):
        model = parts.servo(JOINTS[name].kind)
        columns[f"cmd.{name}"] = motion.commands[:, j].copy()
        columns[f"pos.{name}"], columns[f"vel.{name}"] = position[:, j], velocity[:, j]
        amps = current[:, j] + senses.current_a * chance.standard_normal(len(last))
        if model.has_current_sensor:
            columns[f"cur.{name}"] = np.rint(amps / AMPERE_PER_COUNT) * AMPERE_PER_COUNT
        else:
            columns[f"load.{name}"] = np.rint(amps / model.stall_current_a * 1000) / 1000
        columns[f"pwm.{name}"] = duty[:, j]
        columns[f"volt.{name}"], columns[f"temp.{name}"] = np.round(volts, 1), case[:, j]
        columns[f"torque.{name}"] = 1.0 - motion.limp[:, j]
        columns[f"ok.{name}"] = np.ones(len(last))
    columns.update(imu_columns(senses, _imu_seen(trace, plan.row - robot.clocks.imu_s), chance))
    if trace.base is not None and robot.tracker:
        columns.update(tracker_columns(senses, _between(trace.base, plan.row - senses.tracker_s), chance))
    columns["cmd_t"] = plan.cmd_t
    return Run(motion.name, facts_of(motion), plan.t, columns)


def _between(values: NDArray[np.float32], at: Array) -> Array:
    """Straight lines between steps, at times `at` (s)."""
    where = np.clip(at / STEP_S, 0, len(values) - 2)
    low = where.astype(int)
    share = (where - low)[:, None]
    out: Array = values[low] * (1 - share) + values[low + 1] * share
    return out


def _rotation(vector: Array) -> Array:
    """(3, 3) of a rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    out: Array = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return out


def imu_columns(senses: Senses, true: Array, chance: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Gyro and accelerometer as logged: turned by the mounting, biased, noisy, rounded; `true` (rows, 6)."""
    turn = _rotation(senses.mount_rad)
    columns: dict[str, NDArray[Any]] = {}
    for name, part, bias, noise, count in (
        ("gyro", slice(0, 3), senses.gyro_bias, senses.gyro_noise, GYRO_COUNT),
        ("acc", slice(3, 6), senses.acc_bias, senses.acc_noise, ACC_COUNT),
    ):
        # The board is turned by `mount`: what it reads is the body's vector in its own axes.
        seen = true[:, part] @ turn + bias
        seen = seen + noise * chance.standard_normal(seen.shape)
        for axis, values in zip("xyz", seen.T, strict=True):
            columns[f"{name}.{axis}"] = np.rint(values / count) * count
    return columns


def tracker_columns(senses: Senses, pose: Array, chance: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Place and heading as logged, of true poses (rows, 7)."""
    w, x, y, z = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))) + senses.tracker_yaw
    place = senses.tracker_scale * pose[:, :3] + senses.tracker_m * chance.standard_normal((len(pose), 3))
    yaw = yaw + senses.tracker_rad * chance.standard_normal(len(pose))
    return {"base.x": place[:, 0], "base.y": place[:, 1], "base.z": place[:, 2], "base.yaw": yaw}


def _imu_seen(trace: Trace, at: Array) -> Array:
    """(rows, 6) behind the IMU's low-pass filters."""
    parts = []
    for part, hz in ((slice(0, 3), GYRO_HZ), (slice(3, 6), ACC_HZ)):
        share = 1 - math.exp(-2 * math.pi * hz * STEP_S)
        raw = trace.imu[:, part].astype(float)
        smooth = lfilter([share], [1, share - 1], raw, axis=0, zi=(1 - share) * raw[:1])[0]
        parts.append(_between(smooth.astype(np.float32), at))
    return np.hstack(parts)
