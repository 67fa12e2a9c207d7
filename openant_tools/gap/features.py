"""What evidence is made of: how a robot's log differs from the simulation's, averaged over pieces long enough to be steady.

Single samples on the floor chatter: a gram more moves them by many deviations. Commands that come late or never leave no mean at all;
they are looked for in what fits leave (`gap.innovations`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.robot import Robot
from openant_tools.model.plant import Setup
from openant_tools.recording.run import Run

__all__ = ["COLUMNS", "Floats", "Layout", "Signals", "around_switching", "differences", "logged", "with_noise"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
#: signal → (robots, rows, columns)
Signals = Mapping[str, Floats]

#: signals of the body → their columns in a run
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "gyro": ("gyro.x", "gyro.y", "gyro.z"),
    "acc": ("acc.x", "acc.y", "acc.z"),
    "base": ("base.x", "base.y", "base.z"),
    "yaw": ("base.yaw",),
}
#: what a servo says of its torque, best first; none in N·m, so that all are brought to the model's own scale
TORQUES = ("cur", "load", "pwm")
#: s: at the start of a run that is left out (where the robot really began is not known well), and of blocks
SKIP_S, STAND_BLOCK_S, ONE_JOINT_BLOCK_S, FLOOR_BLOCK_S = 0.5, 0.1, 0.05, 0.2
#: signals of which only changes are looked at: a foot that slips once as it begins to move puts the whole run elsewhere
DRIFTING = ("base", "yaw")
#: s after torque comes on in which servos differ: one starts from where it is, another from where it was last told to go
TAKES_UP_S = 0.3
#: s after torque is gone in which what a servo says of it may be old
LETS_GO_S = 0.03
#: factors within which one joint may need another scale of torque than most: servos of a robot differ so far in N·m per ampere
OWN_SCALE = 2.0


@dataclass(frozen=True)
class Layout:
    """How the rows of one run become features.

    Attributes:
        t: (rows,) s since the run's start. setup: how the robot stood. joints: how many.
        signals: which, in order; positions of joints among them.
        seconds: how long the protocol's run is: a log that goes on longer is cut there.
        unsure: (rows, joints) as `around_switching`.
    """

    t: Array
    setup: Setup
    joints: int
    signals: tuple[str, ...]
    seconds: float
    unsure: Bools

    def blocks(self, signal: str) -> Array:
        """Edges of the blocks of a signal, s."""
        if self.setup is Setup.FLOOR or signal in COLUMNS:
            width = FLOOR_BLOCK_S
        else:
            width = ONE_JOINT_BLOCK_S if self.joints <= 2 else STAND_BLOCK_S
        count = max(1, int((self.seconds - SKIP_S) / width + 1e-6))
        edges: Array = SKIP_S + width * np.arange(count + 1, dtype=np.float64)
        return edges

    def joints_of(self, signal: str) -> list[int]:
        """The joint of each of a signal's features, in the order of `features`; −1 for those of no joint."""
        blocks = len(self.blocks(signal)) - 1
        return [-1] * (blocks * len(COLUMNS[signal])) if signal in COLUMNS else [*range(self.joints)] * blocks

    def features(self, seen: Signals, simulated: Signals) -> Floats:
        """(robots, features): block means of how logs differ from what the model does.

        Args:
            seen: (robots, rows, columns) of each signal. simulated: the same of the model, one for all robots.
        """
        parts, apart = [], differences(seen, simulated, self.signals)
        if self.unsure.any():
            apart |= {
                name: np.where(self.unsure, np.float32(np.nan), x) for name, x in apart.items() if name not in COLUMNS
            }
        for signal in self.signals:
            means = _means(apart[signal], self.t, self.blocks(signal))
            if signal in DRIFTING:
                means = means - _mean(means)[:, None]
            parts.append(np.nan_to_num(means).reshape(len(means), -1))
        return np.concatenate(parts, axis=1).astype(np.float32)

    def known(self, seen: Signals) -> Bools:
        """(features,) which of them a log of (1, rows, columns) signals has: those of which it has any sample."""
        parts: list[Bools] = []
        for signal in self.signals:
            n = len(COLUMNS[signal]) if signal in COLUMNS else self.joints
            there = np.isfinite(seen[signal][:1]) if signal in seen else np.zeros((1, len(self.t), n), bool)
            if signal not in COLUMNS:
                there = there & ~self.unsure
            counts = _means(np.where(there, 1.0, np.nan).astype(np.float32), self.t, self.blocks(signal))
            parts.append(np.isfinite(counts[0]).ravel())
        return np.concatenate(parts)


def around_switching(run: Run, joints: Sequence[str]) -> Bools:
    """(rows, joints): where torque has just come on, and nobody knows what a late or slow servo still had in mind.

    And, for as long as a reading may be old, where it has just gone.
    """
    off = run.signal("torque", joints, default=1.0) == 0
    out = np.zeros(off.shape, bool)
    for row, joint in np.argwhere(off[:-1] != off[1:]):
        lasts = TAKES_UP_S if off[row, joint] else LETS_GO_S
        out[:, joint] |= (run.t > run.t[row]) & (run.t < run.t[row + 1] + lasts)
    return out


def logged(run: Run, joints: Sequence[str]) -> dict[str, Floats]:
    """The signals that a run has, (1, rows, columns) each; torque in whatever unit the servo gives it."""
    out: dict[str, Floats] = {}
    for name in ("pos", "vel"):
        if run.has(name, joints):
            out[name] = run.signal(name, joints)[None].astype(np.float32)
    # Servos of two models on one bus say it in two ways, each joint in its own.
    torque = np.full((len(run.t), len(joints)), np.nan, np.float32)
    for j, joint in enumerate(joints):
        said = next((name for name in TORQUES if run.has(name, [joint])), None)
        if said:
            torque[:, j] = run.column(f"{said}.{joint}")
    if np.isfinite(torque).any():
        out["torque"] = torque[None]
    if run.has("volt", joints):
        volts = run.signal("volt", joints)
        supply = run.facts.supply_v or float(np.nanpercentile(volts, 95))
        out["volt"] = (volts / supply)[None].astype(np.float32)
    for name, columns in COLUMNS.items():
        values = np.stack([run.column(column) for column in columns], axis=1)
        if np.isfinite(values).any():
            if name == "yaw":
                values = _unwrapped(values)
            out[name] = values[None].astype(np.float32)
    return out


def differences(seen: Signals, simulated: Signals, names: Sequence[str]) -> dict[str, Floats]:
    """What was seen minus what the model does, (robots, rows, columns) each.

    A torque is scaled first, so that it fits the model's best: its unit is not known, and no two servos have quite the same. Supplies are shares of
    what they give unloaded. Base and heading count from where the robot started.
    """
    out: dict[str, Floats] = {}
    for name in names:
        x, model = seen[name], simulated[name]
        if name == "torque":
            known = np.where(np.isfinite(x), model, 0.0)
            # A driver without a sign tells only how much.
            negative = np.any(np.nan_to_num(x) < 0, axis=(1, 2), keepdims=True)
            unsigned = ~negative & np.any(known < 0, axis=(1, 2), keepdims=True)
            known, model = np.where(unsigned, np.abs(known), known), np.where(unsigned, np.abs(model), model)
            power = np.einsum("rtj,rtj->rj", known, known)
            slope = np.einsum("rtj,rtj->rj", np.nan_to_num(x), np.broadcast_to(known, x.shape)) / np.maximum(
                power, 1e-12
            )
            usual = np.median(np.abs(slope), axis=1, keepdims=True)
            scale = np.clip(np.abs(slope), usual / OWN_SCALE, usual * OWN_SCALE)
            out[name] = (x / np.maximum(scale, 1e-12)[:, None] - model).astype(np.float32)
        elif name == "volt":
            out[name] = (x / _unloaded(x) - 1).astype(np.float32)
        elif name in ("base", "yaw"):
            apart = _from_start(x) - _from_start(model)
            # Whole turns are those of whoever counted them.
            out[name] = (np.remainder(apart + np.pi, 2 * np.pi) - np.pi if name == "yaw" else apart).astype(np.float32)
        else:
            out[name] = (x - model).astype(np.float32)
    return out


def with_noise(
    signals: Signals, robots: Sequence[Robot], resolution: Mapping[str, float], rng: np.random.Generator, t: Array
) -> dict[str, Floats]:
    """What imperfect sensors make of the truth: noise of each robot's own size, and steps; servos are read a little off the stamp.

    Args:
        t: (rows,) s, the stamps.
    """
    out: dict[str, Floats] = {}
    scatter = np.array([robot.noise.get("stamp", 0.0) for robot in robots], np.float32)[:, None, None]
    off = scatter * rng.standard_normal((len(robots), len(t), 1), np.float32).clip(-3, 3)
    for name, x in signals.items():
        if name in ("pos", "vel"):
            x = x + off * np.gradient(x, t, axis=1)
        noise = np.array([robot.noise.get(name, 0.0) for robot in robots], np.float32)[:, None, None]
        scale = 1.0
        if name == "torque":
            # A current sensor's noise is a share of what the servo usually gives.
            scale = np.maximum(np.nanstd(x, axis=1, keepdims=True), 1e-6)
        y = x + noise * scale * rng.standard_normal(x.shape, np.float32)
        if name == "torque":
            zero = np.array([robot.noise.get("torque_zero", 0.0) for robot in robots], np.float32)[:, None, None]
            y = y + zero * scale * rng.standard_normal((len(x), 1, x.shape[2]), np.float32)
        step = resolution.get(name, 0.0)
        if name == "volt":
            between = np.array([robot.noise.get("volt_between", 0.0) for robot in robots], np.float32)[:, None, None]
            y = y + step * between
        out[name] = (np.round(y / step) * step if step > 0 else y).astype(np.float32)
    return out


def _unloaded(x: Floats) -> Floats:
    """(robots, 1, 1) what a supply gives where little is asked: the mean of its better half, since steps of sensors are coarse."""
    values = x.reshape(len(x), -1)
    with np.errstate(invalid="ignore"):
        better = np.where(values >= np.nanmedian(values, axis=1, keepdims=True), values, np.nan)
    out: Floats = np.nanmean(better, axis=1)[:, None, None]
    return out


def _from_start(x: Floats) -> Floats:
    """(robots, rows, columns) from where each log begins, which may be later than its run."""
    known = np.flatnonzero(np.isfinite(x[0]).all(axis=1))[:3]
    out: Floats = x - x[:, known].mean(axis=1, keepdims=True) if len(known) else x
    return out


def _mean(x: Floats) -> Floats:
    """(robots, columns) means over rows of what is finite; NaN where nothing is."""
    known = np.isfinite(x)
    count = known.sum(axis=1)
    out: Floats = np.where(count > 0, np.where(known, x, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
    return out


def _unwrapped(values: Array) -> Array:
    out = values.copy()
    seen = np.isfinite(out[:, 0])
    out[seen, 0] = np.unwrap(out[seen, 0])
    return out


def _means(x: Floats, t: Array, edges: Array) -> Floats:
    """(robots, blocks, columns) means of the finite samples between edges; NaN where there is none."""
    at = np.searchsorted(t, edges)
    inside = slice(at[0], max(at[-1], at[0] + 1))
    finite = np.isfinite(x[:, inside])
    values = np.where(finite, x[:, inside], 0.0)
    starts = np.clip(at[:-1] - at[0], 0, values.shape[1] - 1)
    total = np.add.reduceat(values, starts, axis=1)
    count = np.add.reduceat(finite.astype(np.float32), starts, axis=1)
    empty = at[:-1] >= at[1:]
    out: Floats = np.where((count > 0) & ~empty[None, :, None], total / np.maximum(count, 1), np.nan)
    return out
