"""Commands: what somebody would play on a robot to get to know it, or what a policy would do."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from machine import HOME, Machine

__all__ = ["Motion", "protocol", "walks"]


@dataclass(frozen=True)
class Motion:
    """One run; `commands` (n, joints) rad, one every `period_s`; `limp` (n, joints) where torque is off."""

    name: str
    protocol: str
    setup: str
    heading_rad: float
    period_s: float
    commands: np.ndarray
    limp: np.ndarray


def _home(machine: Machine) -> np.ndarray:
    return np.array([HOME[kind] for kind in machine.kinds])


def _reach(machine: Machine) -> np.ndarray:
    return np.array([0.5 if kind == "hip" else 0.32 for kind in machine.kinds])


def _chirp(t: np.ndarray, n: int, chance: np.random.Generator) -> np.ndarray:
    low, high = float(chance.uniform(0.15, 0.4)), float(chance.uniform(1.5, 3.5))
    turns = low * t + (high - low) * t**2 / (2 * t[-1])
    signs, size = chance.choice([-1, 1], n), chance.uniform(0.4, 1.0, n)
    return size * signs * np.sin(2 * math.pi * turns)[:, None]


def _steps(t: np.ndarray, n: int, chance: np.random.Generator) -> np.ndarray:
    every = float(chance.uniform(0.35, 1.0))
    index = (t / every).astype(int)
    return chance.uniform(-1, 1, (index[-1] + 1, n))[index]


def _multisine(t: np.ndarray, n: int, chance: np.random.Generator) -> np.ndarray:
    hz, phase = chance.uniform(0.2, 2.5, (5, n)), chance.uniform(0, 2 * math.pi, (5, n))
    return np.sin(2 * math.pi * hz * t[:, None, None] + phase).sum(1) / 3.0


def _reversals(t: np.ndarray, n: int, chance: np.random.Generator) -> np.ndarray:
    period, phase = chance.uniform(1.5, 4.0, n), chance.uniform(0, 1, n)
    return (2 * np.abs(2 * ((t[:, None] / period + phase) % 1.0) - 1) - 1) * chance.uniform(0.3, 0.9, n)


def _holds(t: np.ndarray, n: int, chance: np.random.Generator) -> np.ndarray:
    every = 1.3
    index = (t / every).astype(int)
    targets = chance.uniform(-0.9, 0.9, (index[-1] + 2, n))
    share = np.clip((t / every - index) / 0.3, 0, 1)[:, None]
    return targets[index] + share * (targets[index + 1] - targets[index])


_STAND = {"chirp": _chirp, "steps": _steps, "multisine": _multisine, "reversals": _reversals, "holds": _holds}


def _shifts(t: np.ndarray, machine: Machine, chance: np.random.Generator) -> np.ndarray:
    n, hz = len(machine.joints), float(chance.uniform(0.3, 0.8))
    phase = chance.uniform(0, 2 * math.pi, n)
    size = np.where(np.array(machine.kinds) == "hip", chance.uniform(0.1, 0.3), chance.uniform(0.1, 0.22))
    return size * np.sin(2 * math.pi * hz * t[:, None] + phase)


def _lifts(t: np.ndarray, machine: Machine, chance: np.random.Generator) -> np.ndarray:
    """One leg after the other: its knee up, its hip to and fro."""
    out = np.zeros((len(t), len(machine.joints)))
    every = float(chance.uniform(0.9, 1.4))
    order = chance.permutation(4)
    for k, when in enumerate(t):
        leg, share = order[int(when / every) % 4], (when / every) % 1.0
        up = math.sin(math.pi * share)
        out[k, 2 * leg + 1] = 0.5 * up
        out[k, 2 * leg] = 0.25 * math.sin(2 * math.pi * share)
    return out


def _gait(t: np.ndarray, machine: Machine, chance: np.random.Generator) -> np.ndarray:
    """A trot: diagonal legs in turn."""
    hz, swing, lift = chance.uniform(0.6, 1.4), chance.uniform(0.15, 0.35), chance.uniform(0.2, 0.4)
    signs = np.array([1.0, -1.0, -1.0, 1.0]) * chance.choice([-1, 1]) if chance.random() < 0.5 else np.ones(4)
    ramp = np.clip(t / 0.6, 0, 1)
    out = np.zeros((len(t), 8))
    for leg in range(4):
        angle = 2 * math.pi * hz * t + math.pi * (leg % 2)
        out[:, 2 * leg] = ramp * signs[leg] * swing * np.cos(angle)
        out[:, 2 * leg + 1] = ramp * lift * np.maximum(0, np.sin(angle))
    return out


def _still(t: np.ndarray, machine: Machine, chance: np.random.Generator) -> np.ndarray:
    return np.zeros((len(t), len(machine.joints)))


def _scrub(t: np.ndarray, machine: Machine, chance: np.random.Generator) -> np.ndarray:
    """All hips to and fro against the floor."""
    out = np.zeros((len(t), len(machine.joints)))
    out[:, ::2] = chance.uniform(0.15, 0.35) * np.sin(2 * math.pi * chance.uniform(0.3, 0.9) * t)[:, None]
    return out


_FLOOR = {"stand": _still, "shifts": _shifts, "lifts": _lifts, "gait": _gait, "scrub": _scrub}


def _within(machine: Machine, commands: np.ndarray) -> np.ndarray:
    low, high = (
        np.array([pair[kind] for kind in machine.kinds])
        for pair in ({"hip": -0.7, "knee": -1.2}, {"hip": 0.7, "knee": -0.25})
    )
    return np.clip(commands, low, high)


def protocol(machine: Machine, chance: np.random.Generator) -> list[Motion]:
    """Two runs on the stand, sometimes three, and as many on the floor where there is one, of 5 to 7 s each."""
    n, home, reach = len(machine.joints), _home(machine), _reach(machine)
    period = 1 / float(chance.choice([20.0, 25.0, 30.0, 40.0, 50.0]))
    releases = bool(chance.random() < 0.5)
    found = []
    for number in range((2 if chance.random() < 0.7 else 3) + (0 if machine.walks else 2)):
        names = chance.choice(list(_STAND), 2 if chance.random() < 0.6 else 1, replace=False)
        pieces = [
            _STAND[name](np.arange(0, chance.uniform(2.6, 3.5) if len(names) > 1 else 5.5, period), n, chance)
            for name in names
        ]
        commands = _within(machine, home + reach * np.concatenate(pieces))
        limp = np.zeros(commands.shape, bool)
        if releases and number % 2 == 1:
            held = int(1.5 / period)
            limp[-held : -held // 3] = True
            commands[-held:] = commands[-held - 1]
        found.append(Motion(f"stand_{number + 1}", "+".join(names), "stand", 0.0, period, commands, limp))
    for number in range((2 if chance.random() < 0.7 else 3) if machine.walks else 0):
        names = chance.choice(list(_FLOOR)[1:], 2 if chance.random() < 0.5 else 1, replace=False)
        pieces = [_still(np.arange(0, 0.4, period), machine, chance)]
        pieces += [
            _FLOOR[name](np.arange(0, chance.uniform(2.4, 3.2) if len(names) > 1 else 5.0, period), machine, chance)
            for name in names
        ]
        commands = _within(machine, home + np.concatenate(pieces))
        heading = float(chance.choice([0.0, math.pi / 2])) + float(chance.uniform(-0.2, 0.2))
        limp = np.zeros(commands.shape, bool)
        found.append(Motion(f"floor_{number + 1}", "+".join(names), "floor", heading, period, commands, limp))
    return found


def walks(machine: Machine, chance: np.random.Generator) -> list[Motion]:
    """Runs on the floor as a policy makes them: a command every 0.12 s, 30 to 60 s in all."""
    home, period = _home(machine), 0.12
    found = []
    for number in range(int(chance.integers(1, 3))):
        seconds = float(chance.uniform(30, 45) if number == 0 else chance.uniform(15, 25))
        t = np.arange(0, seconds, period)
        commands = np.zeros((len(t), 8))
        at = 5
        while at < len(t):
            # Now and then it does something else, as policies that still explore do.
            rows = slice(at, at + int(chance.integers(15, 60)))
            commands[rows] = _gait(t[rows] - t[at], machine, chance)
            at = rows.stop
        wander = np.zeros(8)
        for row in commands[5:]:
            wander = 0.75 * wander + chance.standard_normal(8) * float(chance.uniform(0.03, 0.08))
            row += wander
        commands = _within(machine, home + commands)
        found.append(
            Motion(
                f"episode_{number + 1}",
                "policy",
                "floor",
                float(chance.uniform(-3, 3)),
                period,
                commands,
                np.zeros(commands.shape, bool),
            )
        )
    return found
