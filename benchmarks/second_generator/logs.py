"""What the host writes down: sampled, late, noisy, rounded, with columns missing as they are on other people's robots."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from answer import Answer, CannotHave
from drives import COUNT_RAD, Drives
from machine import Machine
from motions import Motion
from play import Clocks, Trace, felt

__all__ = ["Senses", "senses_of", "write_run"]

VELOCITY_COUNT = 0.229 * 2 * math.pi / 60
MOTORS = {"hip": "XC430-W240-T", "knee": "XM430-W350-T"}
STALL_A = {"hip": 1.4, "knee": 2.3}


@dataclass
class Senses:
    """Which columns there are, and how they measure.

    Attributes:
        current: "knees", "all" or "" (then what loads show); its filter (s), factor, standby (A), count (A), clip (A), and
            whether standby and sign are the supply's (unsigned but for the motion's sign).
        tracker_hz: 0 for a pose in every row.
    """

    velocity_s: float
    current: str
    load: bool
    pwm: bool
    volt: bool
    temp: bool
    imu: bool
    tracker: bool
    cmd_t: bool
    csv: bool
    current_s: float
    current_factor: np.ndarray
    standby_a: float
    standby_signed: bool
    current_count: float
    clip_a: float
    noise_a: float
    gyro_noise: float
    acc_noise: float
    imu_hz: float
    mount: np.ndarray
    gyro_bias: np.ndarray
    acc_bias: np.ndarray
    tracker_hz: float
    tracker_m: float
    tracker_rad: float
    tracker_late_s: float
    scale: float = 1.0
    yaw: float = 0.0
    late_share: float = 0.0


def senses_of(machine: Machine, answer: Answer, policy: bool, chance: np.random.Generator) -> Senses:
    def likely(share: float) -> bool:
        return bool(chance.random() < share)

    n = len(machine.joints)
    imu_asked = any(
        e.name.startswith("imu_") or (e.name == "sensor_delay" and e.joints == "body") for e in answer.effects
    )
    senses = Senses(
        velocity_s=float(chance.uniform(2e-3, 6e-3)), current=str(chance.choice(["", "knees", "knees", "all"])),
        load=likely(0.6), pwm=likely(0.4), volt=likely(0.5), temp=likely(0.4), imu=likely(0.75) or imu_asked,
        tracker=answer.tracker, cmd_t=likely(0.75), csv=likely(0.15),
        current_s=float(np.exp(chance.uniform(math.log(1e-3), math.log(3e-2)))),
        current_factor=1 + 0.1 * chance.uniform(-1, 1) + 0.04 * chance.uniform(-1, 1, n),
        standby_a=float(chance.choice([0.0, chance.uniform(0.01, 0.06)])), standby_signed=likely(0.5),
        current_count=float(chance.choice([0.00269, 0.00269, 0.0065, 0.01])),
        clip_a=float(chance.choice([9.0, chance.uniform(0.5, 1.0)])), noise_a=float(chance.uniform(1e-3, 1.2e-2)),
        gyro_noise=float(chance.uniform(1e-3, 8e-3)), acc_noise=float(chance.uniform(0.02, 0.15)),
        imu_hz=float(chance.uniform(80, 200)), mount=math.radians(0.5) * chance.uniform(-1, 1, 3),
        gyro_bias=5e-3 * chance.uniform(-1, 1, 3), acc_bias=0.05 * chance.uniform(-1, 1, 3),
        tracker_hz=float(chance.choice([0.0, 28.0, 40.0])), tracker_m=float(chance.uniform(5e-4, 3e-3)),
        tracker_rad=float(chance.uniform(2e-3, 1e-2)), tracker_late_s=float(chance.uniform(0.0, 4e-3)),
    )  # fmt: skip
    if policy:
        senses.current, senses.load, senses.tracker_hz, senses.imu = "knees", True, 28.0, True
        senses.tracker, senses.cmd_t, senses.csv = True, True, False
        senses.late_share = float(chance.choice([0.0, chance.uniform(0.0, 0.1)]))
    if not machine.walks:
        if imu_asked:
            raise CannotHave("an arm on a bench has no IMU")
        senses.imu = senses.tracker = False
    for effect in answer.effects:
        p = effect.parameters
        match effect.name:
            case "imu_misalignment":
                senses.mount = np.asarray(p["rotation_rad"])
            case "imu_bias":
                senses.gyro_bias, senses.acc_bias = np.asarray(p["rad_s"]), np.asarray(p["m_s2"])
            case "tracker_scale":
                senses.scale, senses.yaw, senses.tracker = p["scale"], p["yaw_rad"], True
                senses.tracker_late_s = p["latency_s"]
            case _:
                pass
    return senses


def _smooth(values: np.ndarray, time_constant: float, dt: float) -> np.ndarray:
    """A first-order low-pass along the first axis."""
    share = 1 - math.exp(-dt / max(time_constant, 1e-9))
    if share > 0.99:
        return values
    # As a convolution with its impulse response, cut where it has vanished.
    length = min(len(values), int(8 * time_constant / dt) + 2)
    kernel = share * (1 - share) ** np.arange(length)
    kernel /= kernel.sum()
    padded = np.concatenate([np.repeat(values[:1], length - 1, axis=0), values])
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)


def _at(values: np.ndarray, when: np.ndarray, dt: float) -> np.ndarray:
    """Straight lines between steps; `when` (rows,) or one column each."""
    where = np.clip(when / dt, 0, len(values) - 1.001)
    low = where.astype(int)
    if when.ndim == 1:
        share = (where - low)[:, None]
        return values[low] * (1 - share) + values[low + 1] * share
    columns = np.arange(values.shape[1])
    return values[low, columns] * (1 - (where - low)) + values[low + 1, columns] * (where - low)


def _rotation(vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def write_run(
    folder: Path,
    machine: Machine,
    drives: Drives,
    clocks: Clocks,
    senses: Senses,
    motion: Motion,
    trace: Trace,
    tilt: tuple[float, float],
    chance: np.random.Generator,
) -> None:
    """One table and its facts."""
    dt, rows, joints = trace.dt, len(trace.row), machine.joints
    n = len(joints)

    def noise(deviation: float, *shape: int) -> np.ndarray:
        return deviation * chance.standard_normal(shape)

    def rounded(values: np.ndarray, count: float) -> np.ndarray:
        return np.rint(values / count) * count

    # Clocks of the host and of the truth begin apart.
    stamp = trace.row + np.clip(noise(clocks.stamp_s, rows), -3 * clocks.stamp_s, 3 * clocks.stamp_s)
    least = 1e-5 * np.arange(rows)
    stamp = np.maximum.accumulate(stamp - least) + least
    offset = float(chance.uniform(0, 1e4)) - stamp[0] if chance.random() < 0.3 else -stamp[0]
    columns: dict[str, np.ndarray] = {"t": stamp + offset}
    when = trace.row[:, None] + clocks.apart_s * np.arange(n) - clocks.joints_s
    position = rounded(_at(trace.encoder, when, dt) + noise(drives.encoder_rad, rows, n), COUNT_RAD)
    velocity = rounded(_at(_smooth(trace.rate, senses.velocity_s, dt), when, dt), VELOCITY_COUNT)
    true = _smooth(trace.current, senses.current_s, dt)
    amps = _at(true, when, dt) * senses.current_factor
    amps = amps + senses.standby_a * (1.0 if senses.standby_signed else np.sign(amps)) + noise(senses.noise_a, rows, n)
    amps = np.clip(rounded(amps, senses.current_count), -senses.clip_a, senses.clip_a)
    duty = _at(trace.u, when, dt) * 0.5
    volts = rounded(_at(trace.volts[:, None], trace.row, dt)[:, 0] + noise(0.03, rows), 0.1)
    heat = trace.case[np.minimum((trace.row / 0.1).astype(int), len(trace.case) - 1)]
    late = chance.random((rows, n)) < senses.late_share
    commands = motion.commands[trace.in_force]
    for j, name in enumerate(joints):
        columns[f"cmd.{name}"] = commands[:, j]
        columns[f"pos.{name}"] = position[:, j]
        columns[f"vel.{name}"] = velocity[:, j]
        if senses.current == "all" or (senses.current == "knees" and machine.kinds[j] == "knee"):
            columns[f"cur.{name}"] = amps[:, j]
        elif senses.load:
            columns[f"load.{name}"] = np.clip(rounded(amps[:, j] / STALL_A[machine.kinds[j]], 1e-3), -1, 1)
        if senses.pwm:
            columns[f"pwm.{name}"] = rounded(duty[:, j], 1 / 885)
        if senses.volt:
            columns[f"volt.{name}"] = volts
        if senses.temp:
            columns[f"temp.{name}"] = np.floor(heat[:, j])
        if motion.limp.any():
            columns[f"torque.{name}"] = 1.0 - motion.limp[trace.in_force, j]
        if senses.late_share:
            for signal in ("pos", "vel", "cur", "load", "pwm", "volt", "temp"):
                column = columns.get(f"{signal}.{name}")
                if column is not None:
                    columns[f"{signal}.{name}"] = np.where(late[:, j], np.nan, column)
            columns[f"ok.{name}"] = 1.0 - late[:, j]
    if senses.imu:
        turn, push = felt(trace, tilt)
        turned = _rotation(senses.mount)
        for name, values, bias, scatter in (
            ("gyro", turn, senses.gyro_bias, senses.gyro_noise), ("acc", push, senses.acc_bias, senses.acc_noise),
        ):  # fmt: skip
            seen = _at(_smooth(values, 1 / (2 * math.pi * senses.imu_hz), dt), trace.row - clocks.imu_s, dt)
            seen = seen @ turned + bias + noise(scatter, rows, 3)
            columns |= {f"{name}.{axis}": seen[:, k] for k, axis in enumerate("xyz")}
    if senses.tracker and trace.pose is not None:
        columns |= _tracked(senses, trace, chance)
    if senses.cmd_t:
        columns["cmd_t"] = trace.sent[trace.in_force] + offset + np.clip(noise(5e-5, rows), -1e-4, 1e-4)
    facts: dict[str, Any] = {
        "joints": list(joints), "motors": {j: MOTORS[k] for j, k in zip(joints, machine.kinds, strict=True)},
        "setup": motion.setup, "protocol": motion.protocol, "model": "nominal.xml", "supply_v": 12.0,
        "resolution": {"pos": COUNT_RAD, "vel": VELOCITY_COUNT}, "answer_joints": machine.stands_in,
    }  # fmt: skip
    if motion.setup == "floor":
        facts["heading_rad"] = round(motion.heading_rad, 3)
    _write(folder / f"{motion.name}.{'csv' if senses.csv else 'parquet'}", columns)
    (folder / f"{motion.name}.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def _tracked(senses: Senses, trace: Trace, chance: np.random.Generator) -> dict[str, np.ndarray]:
    assert trace.pose is not None
    pose = _at(trace.pose, trace.row - senses.tracker_late_s, trace.dt)
    w, x, y, z = pose[:, 3:7].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))) + senses.yaw
    place = senses.scale * pose[:, :3] + senses.tracker_m * chance.standard_normal((len(pose), 3))
    yaw = yaw + senses.tracker_rad * chance.standard_normal(len(pose))
    if senses.tracker_hz:
        frame = np.floor((trace.row + chance.uniform(0, 0.03)) * senses.tracker_hz)
        fresh = np.diff(frame, prepend=-1) > 0
        place[~fresh], yaw[~fresh] = np.nan, np.nan
    return {"base.x": place[:, 0], "base.y": place[:, 1], "base.z": place[:, 2], "base.yaw": yaw}


def _write(path: Path, columns: dict[str, np.ndarray]) -> None:
    table = pa.table({name: pa.array(values, mask=~np.isfinite(values)) for name, values in columns.items()})
    if path.suffix == ".parquet":
        pq.write_table(table, path, compression="zstd")
    else:
        pa_csv.write_csv(table, path)
