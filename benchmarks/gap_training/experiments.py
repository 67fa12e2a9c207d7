"""Experiments at random, to learn from: a robot, its model, motions that it plays, and what sensors it has.

Robots of one to six joints on a bench, and Open Ants on a stand and on the floor: pendulums and arms with axes of any direction, with
servos from a twentieth of a newton metre to ten. Logs of 20 to 300 Hz, commands of every row or held as a policy holds them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.gap import experiment as recorded
from openant_tools.gap.population import Case, draw, robot_of
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.sensors import logged_by
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.sysid.excitation import CommandSpace, Segment, fade
from openant_tools.sysid.floor_motion import Gait, LegLifts, PushUps, Scrub, WeightShifts

__all__ = ["Experiment", "experiment"]

Array = NDArray[np.float64]

#: share of Open Ants among the robots
ANTS = 0.65
#: steps of encoders, rad: 4096 a turn, 1024 in 300°, 14 bits; and how often each comes
ENCODERS_RAD, ENCODERS = (2 * math.pi / 4096, math.radians(300) / 1024, 2 * math.pi / 16384), (0.7, 0.15, 0.15)
#: s that a run lasts, of several and by itself, and all of an experiment
LASTS_S, ALONE_S, WHOLE_S = (2.5, 5.5), (7.0, 10.0), 10.0
#: Hz, rows of logs of Ants and of others
RATES_HZ = {True: (40.0, 150.0), False: (20.0, 300.0)}
#: s that a policy's command is held; share of runs in which commands are held so long
HELD_S, HELD = (0.05, 0.15), 0.4
#: share of logs that have each signal
SENSORS = {"vel": 0.9, "torque": 0.7, "volt": 0.4, "imu": 0.75, "base": 0.5}
#: s, deviation of stamps about an even clock
CLOCK_S = 3e-4
#: rad/s, natural frequency beyond which no servo of a random arm goes
FASTEST_RAD_S = 120.0


@dataclass(frozen=True)
class Experiment:
    """What was recorded, in windows, and what the robot had that did it."""

    protocol: RunSet
    truth: Case


def experiment(seed: int, folder: Path) -> Experiment:
    """The experiment of a seed; its model goes into a folder."""
    rng = np.random.default_rng((4021, seed))
    ant = bool(rng.random() < ANTS)
    model = folder / f"{seed}.xml"
    model.write_text(_ant(rng) if ant else _arm(rng))
    joints = tuple(JOINTS) if ant else tuple(f"joint{k}" for k in range(mujoco.MjModel.from_xml_path(str(model)).nu))
    has = {signal: bool(rng.random() < share) for signal, share in SENSORS.items()}
    rate = math.exp(rng.uniform(*np.log(RATES_HZ[ant])))
    encoder = float(rng.choice(ENCODERS_RAD, p=ENCODERS))
    setups = _setups(rng, ant=ant)
    lasts = ALONE_S if len(setups) == 1 else (LASTS_S[0], min(LASTS_S[1], WHOLE_S / len(setups)))
    asked = [_asked(rng, setup, joints, rate, lasts) for setup in setups]
    played = RunSet.of(asked, model, joints, [None] * len(asked)).coarse()
    truth = draw(played, seed)
    steps = {"pos": encoder, "vel": float(rng.choice([0.024, 0.0, 0.005])), "volt": 0.1 / 12}
    robot, runs = robot_of(played, truth), []
    for k, one in enumerate(played.runs):
        found = simulate(Rollouts(one.plant, [one.run], nthread=1), [robot], seed * 64 + k, one.signals).signals
        runs.append(_logged(one.run, logged_by([robot], found, steps, rng, one.layout.t), joints, has))
    cut = recorded.Experiment.of(runs, model, joints)
    return Experiment(cut.protocol.coarse(), truth)


def _setups(rng: np.random.Generator, *, ant: bool) -> list[Setup]:
    """Those of its runs: stands, floors or both."""
    count = int(rng.integers(1, 5))
    if not ant:
        return [Setup.STAND] * count
    kind = rng.choice(3, p=(0.2, 0.3, 0.5))
    both = [Setup.STAND, Setup.FLOOR]
    return [both[kind] if kind < 2 else both[k % 2] for k in range(max(count, 2 if kind == 2 else 1))]


def _factor(rng: np.random.Generator, spread: float) -> float:
    return float(np.exp(spread * rng.normal()))


def _ant(rng: np.random.Generator) -> str:
    """An Open Ant with other servos and masses."""
    spec = mujoco.MjSpec.from_string(nominal_mjcf("standard" if rng.random() < 0.7 else "lite"))
    gain, damping, limit, mass = _factor(rng, 0.35), _factor(rng, 0.35), _factor(rng, 0.25), _factor(rng, 0.15)
    armature = _factor(rng, 0.3)
    friction = float(rng.choice([0.0, 0.01, 0.03, 0.06]))
    for one in spec.actuators:
        one.gainprm[0] *= gain
        one.biasprm[1] *= gain
        one.biasprm[2] *= damping
        one.forcerange = [limit * value for value in one.forcerange]
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.damping, joint.armature = np.array(joint.damping) * damping, joint.armature * armature
            joint.frictionloss += friction
    for geom in spec.geoms:
        geom.density *= mass
        if np.isfinite(geom.mass):
            geom.mass *= mass
    spec.compile()
    return str(spec.to_xml())


def _arm(rng: np.random.Generator) -> str:
    """A serial arm on a bench; of one joint a pendulum."""
    count = int(rng.choice([1, 2, 3, 4, 6], p=(0.35, 0.2, 0.15, 0.15, 0.15)))
    # What its first servo holds; those farther out hold less.
    torque = math.exp(rng.uniform(math.log(0.3 if count > 1 else 0.1), math.log(10.0)))
    reach = float(rng.uniform(0.06, 0.2)) * (torque / 0.5) ** 0.25
    axes = {"across": "0 1 0", "along": "1 0 0", "up": "0 0 1"}
    body, close, actuators = "", "", ""
    for k in range(count):
        left = count - k
        holds = torque * (left / count) ** 1.2
        mass = holds / (9.81 * reach * left) * float(rng.uniform(0.1, 0.6)) / left
        inertia = mass * (reach * left) ** 2
        stiffness = holds / math.radians(rng.uniform(3.0, 25.0))
        armature = max(inertia * float(rng.uniform(0.2, 3.0)), stiffness / FASTEST_RAD_S**2)
        damping = float(rng.uniform(0.3, 1.6)) * 2 * math.sqrt(stiffness * (inertia + armature))
        driver = damping * float(rng.choice([0.0, 0.5, rng.random()]))
        friction = holds * float(rng.choice([0.0, 0.0, rng.uniform(0.01, 0.12)]))
        axis = axes[str(rng.choice(list(axes)))] if count > 1 or rng.random() < 0.3 else axes["across"]
        at = "0 0 0.5" if not k else f"0 0 {-reach:.5f}"
        body += (
            f'<body name="link{k}" pos="{at}"><inertial pos="0 0 {-reach * rng.uniform(0.4, 1):.5f}" mass="{mass:.6f}" '
            f'diaginertia="{inertia / 12:.8f} {inertia / 12:.8f} {inertia / 40:.8f}"/>'
            f'<joint name="joint{k}" axis="{axis}" damping="{damping - driver:.6f}" armature="{armature:.8f}" '
            f'frictionloss="{friction:.6f}"/>'
        )
        close += "</body>"
        actuators += (
            f'<position name="joint{k}" joint="joint{k}" kp="{stiffness:.5f}" kv="{driver:.6f}" '
            f'forcerange="{-holds:.5f} {holds:.5f}"/>'
        )
    return (
        '<mujoco model="arm"><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{body}{close}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )


def _asked(
    rng: np.random.Generator, setup: Setup, joints: tuple[str, ...], rate: float, lasts: tuple[float, float]
) -> Run:
    """A run that only commands yet."""
    seconds = float(rng.uniform(*lasts))
    t = np.arange(0.0, seconds, 1 / rate)
    space = _space(rng, joints)
    offsets, limp = _motion(rng, setup, space, t, seconds)
    commands = np.clip(space.home + offsets, space.low, space.high)
    if rng.random() < HELD:
        every = max(1, round(float(rng.uniform(*HELD_S)) * rate))
        commands = np.repeat(commands[::every], every, axis=0)[: len(t)]
    stamps = t + rng.normal(0, CLOCK_S, len(t)).clip(-0.3 / rate, 0.3 / rate)
    sent = stamps + float(rng.uniform(0, 0.2 / rate))
    columns = {"cmd_t": sent}
    for j, joint in enumerate(joints):
        columns[f"cmd.{joint}"] = columns[f"pos.{joint}"] = commands[:, j]
        if limp.any():
            columns[f"torque.{joint}"] = 1.0 - limp[:, j]
    heading = float(rng.choice([0.0, math.pi / 2, math.pi, -math.pi / 2])) if setup is Setup.FLOOR else None
    name = f"{setup}{rng.integers(10**6)}"
    return Run(name, Facts(joints=joints, setup=str(setup), heading_rad=heading, supply_v=12.0), stamps, columns)


def _space(rng: np.random.Generator, joints: tuple[str, ...]) -> CommandSpace:
    if set(joints) == set(JOINTS):
        return CommandSpace.around_home(joints=joints, reach_rad=float(rng.uniform(0.3, 0.6)))
    reach = float(rng.uniform(0.3, 1.6 if len(joints) == 1 else 0.9))
    home = rng.uniform(-0.4, 0.4, len(joints))
    return CommandSpace(joints, home, home - reach, home + reach)


def _motion(
    rng: np.random.Generator, setup: Setup, space: CommandSpace, t: Array, seconds: float
) -> tuple[Array, NDArray[np.bool_]]:
    """(rows, joints) rad beside home, and where torque is off."""
    limp = np.zeros((len(t), len(space.joints)), bool)
    if setup is Setup.FLOOR:
        if rng.random() < 0.35:
            return _wandering(rng, space, t, seconds), limp
        kinds: list[type[Segment]] = [WeightShifts, Scrub, LegLifts, Gait, PushUps]
        parts = [kinds[k] for k in rng.choice(len(kinds), int(rng.integers(1, 4)))]
        each, out = seconds / len(parts), np.zeros((len(t), len(space.joints)))
        for n, kind in enumerate(parts):
            mine = (t >= n * each) & (t < (n + 1) * each)
            out[mine] = kind(each).offsets(t[mine] - n * each, space.standing(), rng)
        return out, limp
    kind = rng.choice(7)
    offsets = (_chirp, _steps, _multisine, _triangles, _wandering, _steps, _waypoints)[kind](rng, space, t, seconds)
    if rng.random() < 0.3:  # one joint alone, or a few
        offsets = offsets * (rng.random(len(space.joints)) < 0.4)
    if rng.random() < 0.1:
        begin, lasts = rng.uniform(0.2, 0.8) * seconds, rng.uniform(0.4, 1.0)
        limp[(t >= begin) & (t < begin + lasts)] = rng.random(len(space.joints)) < 0.7
    return offsets, limp


def _chirp(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    low, high = np.exp(rng.uniform(np.log([0.1, 1.0]), np.log([0.8, 5.0])))
    phase = 2 * np.pi * low * seconds / math.log(high / low) * ((high / low) ** (t / seconds) - 1)
    size = rng.uniform(0.2, 1.0, len(space.joints)) * space.half * np.minimum(1, (2.0 / np.maximum(low, 0.3)))
    out: Array = (
        np.sin(phase[:, None] + rng.uniform(0, 2 * np.pi, len(space.joints))) * size * fade(t, seconds)[:, None]
    )
    return out


def _steps(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    every = float(rng.uniform(0.25, 1.2))
    levels = rng.uniform(-1, 1, (int(seconds / every) + 2, len(space.joints))) * rng.uniform(0.2, 1.0)
    levels[0] = 0
    shift = rng.uniform(0, every, len(space.joints)) * (rng.random() < 0.5)
    at = np.clip(((t[:, None] - shift) / every).astype(int), 0, len(levels) - 1)
    out: Array = np.take_along_axis(levels, at, axis=0) * space.half
    return out


def _multisine(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    count = int(rng.integers(3, 9))
    hz = np.exp(rng.uniform(math.log(0.2), math.log(4.0), (count, len(space.joints))))
    waves = np.sin(2 * np.pi * hz * t[:, None, None] + rng.uniform(0, 2 * np.pi, hz.shape)) / np.sqrt(hz)
    waves = waves.sum(axis=1)
    out: Array = waves / np.abs(waves).max(axis=0) * rng.uniform(0.3, 1.0) * space.half * fade(t, seconds)[:, None]
    return out


def _triangles(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    hz = np.exp(rng.uniform(math.log(0.1), math.log(1.0), len(space.joints)))
    wave = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * hz * t[:, None]))
    out: Array = wave * rng.uniform(0.2, 1.0, len(space.joints)) * space.half
    return out


def _wandering(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    """As a half-taught policy asks for: a rhythm of its own at each joint, with noise."""
    hz = float(rng.uniform(0.5, 2.5)) * (1 + 0.02 * rng.normal(size=len(space.joints)))
    size = rng.uniform(0.1, 1.0, len(space.joints))
    wave = np.sin(2 * np.pi * hz * t[:, None] + rng.uniform(0, 2 * np.pi, len(space.joints))) * size
    noise = rng.normal(size=(int(seconds / 0.12) + 2, len(space.joints))) * rng.uniform(0.0, 0.4)
    grid = 0.12 * np.arange(len(noise))
    wave += np.stack([np.interp(t, grid, column) for column in noise.T], axis=1)
    out: Array = wave * rng.uniform(0.3, 1.0) * space.half * np.clip(t / 0.3, 0, 1)[:, None]
    return out


def _waypoints(rng: np.random.Generator, space: CommandSpace, t: Array, seconds: float) -> Array:
    count = max(2, int(seconds / math.exp(rng.uniform(math.log(0.3), math.log(3.0)))))
    levels = rng.uniform(-1, 1, (count + 1, len(space.joints)))
    levels[0] = 0
    at = np.clip(t / seconds * count, 0, count - 1e-9)
    k, f = at.astype(int), (at % 1)[:, None]
    f = np.clip(f / (1 - rng.uniform(0, 0.7)), 0, 1)
    f = f * f * (3 - 2 * f)
    out: Array = (levels[k] * (1 - f) + levels[k + 1] * f) * space.half
    return out


def _logged(run: Run, logs: dict[str, NDArray[np.float32]], joints: tuple[str, ...], has: dict[str, bool]) -> Run:
    """The run with what its sensors logged; those that it has."""
    columns = dict(run.columns)
    pos = logs["pos"][0].astype(float)
    for j, joint in enumerate(joints):
        columns[f"pos.{joint}"] = pos[:, j]
        for signal, name in (("vel", "vel"), ("torque", "cur"), ("volt", "volt")):
            if has[signal] and signal in logs:
                columns[f"{name}.{joint}"] = logs[signal][0, :, j].astype(float) * (12.0 if signal == "volt" else 1.0)
    if "gyro" in logs:
        for signal, there in (("gyro", has["imu"]), ("acc", has["imu"]), ("base", has["base"])):
            if there:
                for k, axis in enumerate("xyz"):
                    columns[f"{signal}.{axis}"] = logs[signal][0, :, k].astype(float)
        if has["base"]:
            columns["base.yaw"] = logs["yaw"][0, :, 0].astype(float)
    return replace(run, columns=columns)
