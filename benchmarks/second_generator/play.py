"""Play one motion on one robot: when what happens, and what truly happened."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
from answer import Answer
from drives import Drives
from machine import Machine, TrueBody
from motions import Motion
from world import GRAVITY, World

__all__ = ["Clocks", "Trace", "clocks_of", "play"]

SETTLE_S = {"stand": 0.4, "floor": 1.5}


@dataclass
class Clocks:
    """Of a robot, s.

    Attributes:
        row_s: period of the rows. jitter_s: of a row about it. stamp_s: of what is written down.
        travel_s: from a command's last byte to its effect. scatter_s: of that. delay, lag, slew, lost, longest: (n,).
        prefilter_hz: of a second-order filter on commands, 0 for none.
        joints_s, imu_s: age of what joints and IMU say. apart_s: between one servo's sample and the next one's.
    """

    row_s: float
    jitter_s: float
    stamp_s: float
    gap_s: float
    travel_s: float
    scatter_s: float
    delay: np.ndarray
    lag: np.ndarray
    slew: np.ndarray
    lost: np.ndarray
    longest: np.ndarray
    prefilter_hz: float = 0.0
    joints_s: float = 0.0
    imu_s: float = 0.0
    apart_s: float = 0.0


def clocks_of(machine: Machine, answer: Answer, policy: bool, chance: np.random.Generator) -> Clocks:
    n = len(machine.joints)
    rate = 100.0 if policy else float(chance.choice([50.0, 60.0, 80.0, 100.0, 125.0, 200.0]))
    clocks = Clocks(
        1 / rate, float(chance.uniform(5e-5, 1e-3)), float(chance.uniform(2e-5, 5e-4)), float(chance.uniform(3e-4, 3e-3)),
        float(chance.uniform(0.0, 6e-4)), float(chance.uniform(0.0, 3e-4)), np.zeros(n), np.zeros(n), np.full(n, np.inf),
        np.zeros(n), np.zeros(n), imu_s=float(chance.uniform(0.0, 8e-4)),
        apart_s=float(chance.uniform(0.0, 1e-3)) / n if chance.random() < 0.5 else 0.0,
    )  # fmt: skip
    for effect in answer.effects:
        at, p = machine.at(effect.joints), effect.parameters
        match effect.name:
            case "action_delay":
                clocks.delay[at] = p["delay_s"]
            case "actuator_lag":
                clocks.lag[at] = p["time_constant_s"]
            case "slew_limit":
                clocks.slew[at] = p["rate_rad_s"]
            case "clock_jitter":
                clocks.scatter_s = p["std_s"]
            case "command_dropout":
                clocks.lost[at], clocks.longest[at] = p["fraction"], p["longest_s"]
            case "sensor_delay" if effect.joints == "body":
                clocks.imu_s += p["delay_s"]
            case "sensor_delay":
                clocks.joints_s = p["delay_s"]
            case _:
                pass
    if answer.outside == "command_prefilter":
        clocks.prefilter_hz = 3.5 / float(answer.parameters["strength"])
    return clocks


@dataclass
class Trace:
    """What happened, at every step of `dt` (s) from t = 0, and when rows and commands were.

    Attributes:
        encoder, rate, current, u: (steps, n). volts: (steps,). case: (steps', n) °C, ten a second.
        pose: (steps, 13) of the torso on the floor. row: (rows,) s. sent: (commands,) s. in_force: (rows,) which command.
    """

    dt: float
    encoder: np.ndarray
    rate: np.ndarray
    current: np.ndarray
    u: np.ndarray
    volts: np.ndarray
    case: np.ndarray
    pose: np.ndarray | None
    row: np.ndarray
    sent: np.ndarray
    in_force: np.ndarray


def _schedule(clocks: Clocks, motion: Motion, chance: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of rows, of commands, and which command is the last that a row knows."""
    seconds = len(motion.commands) * motion.period_s
    row = 0.05 + np.arange(0, seconds, clocks.row_s)
    row = row + np.clip(chance.standard_normal(len(row)), -3, 3) * clocks.jitter_s
    row[1:] = np.maximum(row[1:], np.maximum.accumulate(row)[:-1] + 2e-4)
    # The host's loop samples, then sends what is due.
    due = 0.05 + np.arange(len(motion.commands)) * motion.period_s
    first = np.minimum(np.searchsorted(row, due - 0.5 * clocks.row_s), len(row) - 1)
    sent = row[first] + clocks.gap_s * (1 + 0.1 * np.abs(chance.standard_normal(len(first))))
    in_force = np.searchsorted(first, np.arange(len(row)), side="right") - 1
    return row, sent, np.maximum(in_force, 0)


def _lost(clocks: Clocks, motion: Motion, chance: np.random.Generator) -> np.ndarray:
    count, n = motion.commands.shape
    lost = np.zeros((count, n), bool)
    for j in np.flatnonzero(clocks.lost):
        most = max(1, round(float(clocks.longest[j]) / motion.period_s))
        share = float(clocks.lost[j])
        at = 1
        while at < count:
            at += int(chance.geometric(min(1.0, share / (1 + most) * 2 / (1 - share))))
            run = int(chance.integers(1, most + 1))
            lost[at : at + run, j] = True
            at += run
    sick = np.flatnonzero(clocks.lost)
    if len(sick) > 1 and chance.random() < 0.5:
        lost[:, sick] = lost[:, sick[:1]]
    return lost


def _goals(
    clocks: Clocks, motion: Motion, sent: np.ndarray, steps: int, dt: float, chance: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(steps, n) what the loops see, and whether torque is on."""
    n, times = motion.commands.shape[1], np.arange(steps) * dt
    arrives = (sent + clocks.travel_s + clocks.scatter_s * chance.standard_normal(len(sent)))[:, None] + clocks.delay
    arrives = np.maximum.accumulate(arrives, axis=0)
    lost = _lost(clocks, motion, chance)
    goal = np.empty((steps, n))
    for j in range(n):
        there = np.flatnonzero(~lost[:, j])
        index = np.searchsorted(arrives[there, j], times, side="right") - 1
        goal[:, j] = np.where(index >= 0, motion.commands[there[np.maximum(index, 0)], j], motion.commands[0, j])
    now, speed = goal[0].copy(), np.zeros(n)
    slow = (clocks.lag > 0) | np.isfinite(clocks.slew)
    if slow.any() or clocks.prefilter_hz:
        share = np.where(clocks.lag > 0, 1 - np.exp(-dt / np.maximum(clocks.lag, 1e-9)), 1.0)
        w = 2 * math.pi * clocks.prefilter_hz
        for row in goal:
            if w:
                speed += dt * (w * w * (row - now) - 1.4 * w * speed)
                now = now + dt * speed
            else:
                now = now + np.clip(share * (row - now), -clocks.slew * dt, clocks.slew * dt)
            row[:] = now
    index = np.searchsorted(sent, times, side="right") - 1
    on = np.where((index >= 0)[:, None], ~motion.limp[np.maximum(index, 0)], True)
    return goal, on.astype(float)


def play(
    machine: Machine, body: TrueBody, drives: Drives, clocks: Clocks, motion: Motion, chance: np.random.Generator
) -> Trace:
    dt, floor = drives.dt, motion.setup == "floor"
    row, sent, in_force = _schedule(clocks, motion, chance)
    steps = int((max(row[-1], sent[-1]) + 0.05) / dt)
    goal, on = _goals(clocks, motion, sent, steps, dt, chance)
    viscous = np.zeros(drives.n) if drives.behind else drives.viscous
    copied = copy.copy(body)
    copied.tree = copy.deepcopy(body.tree)
    world = World(machine, copied, floor, motion.heading_rad, dt, drives.at_joint, viscous)
    drives.start(world.q)
    for _ in range(round(SETTLE_S[motion.setup] / dt)):
        world.step(drives.step(goal[0], on[0], world.q, world.v))
    n, tenth = drives.n, max(1, round(0.1 / dt))
    encoder, rate, current, u = (np.empty((steps, n)) for _ in range(4))
    volts, case, states = np.empty(steps), np.empty((steps // tenth + 1, n)), np.empty((steps, len(world.state)))
    for k in range(steps):
        torque = drives.step(goal[k], on[k], world.q, world.v)
        encoder[k], rate[k], current[k], u[k], volts[k] = (
            drives.encoder,
            world.v,
            drives.current,
            drives.u * on[k],
            drives.volts,
        )
        if k % tenth == 0:
            case[k // tenth] = drives.case
        states[k] = world.state
        world.step(torque)
    pose = world.pose(states.T).T if floor else None
    return Trace(dt, encoder, rate, current, u, volts, case[: (steps - 1) // tenth + 1], pose, row, sent, in_force)


def felt(trace: Trace, tilt: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """(steps, 3) rad/s and m/s² in the body's axes."""
    steps = len(trace.volts)
    if trace.pose is None:
        return np.zeros((steps, 3)), np.tile([0.0, 0.0, GRAVITY], (steps, 1))
    speed, turn = trace.pose[:, 7:10], trace.pose[:, 10:13]
    across = GRAVITY * math.sin(tilt[0])
    gravity = np.array([across * math.cos(tilt[1]), across * math.sin(tilt[1]), -GRAVITY * math.cos(tilt[0])])
    push = np.gradient(speed, trace.dt, axis=0) - gravity
    w, x, y, z = trace.pose[:, 3:7].T
    turned = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    return np.einsum("kij,ki->kj", turned, turn), np.einsum("kij,ki->kj", turned, push)
