"""Recordings and run tables as one log of bus transactions: what was lost, how, and what else was seen at that moment.

Everything but `t` and one joint may be missing. Where `ok.J` is missing, a loss is what `err.J` names; where both are,
it is a row in which none of the joint's measurements is there although they usually are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.recording.run import Run

__all__ = ["WORDS", "BusLog", "read_log"]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: code of `BusLog.word`: 0 is no loss, the last one a loss of which nobody said how
WORDS = ("", "timeout", "crc", "short", "late", "port", "lost")
_CODE = {word: code for code, word in enumerate(WORDS)}
#: measurements that every answer brings
_MEASURED = ("pos", "vel", "volt", "temp", "cur", "load", "pwm", "tick", "rtt")
#: a column that is empty more often than this is sampled rarely; it does not tell of losses
_SPARSE = 0.7
#: s, lags tried between a command and its joint. rows from which a fit may be made
_LAGS_S, _FEWEST = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4), 20


@dataclass(frozen=True)
class BusLog:
    """All runs behind each other, n rows of J joints.

    Attributes:
        t: (n,) s; each run begins a second after the one before it ended. run: (n,) which run.
        lost: (n, J), whether no valid answer came in time; asked: whether one was wanted.
        word: (n, J) index into `WORDS`.
        rtt, volt, tick: (n, J) s, V, ms; NaN where not known.
        angle: (n, J) rad, gaps filled by the command's shape where there is one.
        speed: (n,) rad/s, of all joints together. load: (n,), effort of all joints together, in A or in full loads.
        wake: (n,) s. cmd_t: (n,) s. period_s: of the loop, median.
        chain: joints as they hang on each cable; empty where nobody said.
        ids: joint → its servo's id; empty where nobody said.
        baud: (runs,) 1/s, NaN where nobody said. facts: of each run.
        shake: (n,), what the body's sensors shake by, NaN without them.
        weight: (n,) cycles that a row stands for: more than 1 where healthy ones were thinned out.
    """

    joints: tuple[str, ...]
    names: tuple[str, ...]
    t: Array
    run: NDArray[np.int64]
    lost: Flags
    asked: Flags
    word: NDArray[np.int8]
    rtt: Array
    volt: Array
    tick: Array
    angle: Array
    speed: Array
    load: Array
    shake: Array
    weight: Array
    wake: Array
    cmd_t: Array
    period_s: float
    chain: tuple[tuple[str, ...], ...]
    ids: Mapping[str, int]
    baud: Array
    facts: tuple[Mapping[str, Any], ...]

    @property
    def seconds(self) -> float:
        """Of all runs together."""
        return float(sum(np.ptp(self.t[self.run == k]) for k in range(len(self.names)) if (self.run == k).any()))

    @property
    def answers(self) -> Array:
        """(J,) answers that were asked for, those of thinned-out cycles included."""
        wanted: Array = (self.asked * self.weight[:, None]).sum(axis=0)
        return wanted

    @property
    def lossy(self) -> Flags:
        """(n,) rows in which something was lost."""
        return np.asarray(self.lost.any(axis=1), bool)


def read_log(runs: Sequence[Run]) -> BusLog:
    """One log of several runs of one robot.

    Raises:
        BadInput: no run has a column that tells of losses or of time on the bus.
    """
    joints = tuple(dict.fromkeys(joint for run in runs for joint in run.joints if _tells(run, joint)))
    if not joints:
        raise BadInput(
            "nothing here tells of the bus",
            where=runs[0].path or runs[0].name,
            remedy="needed is one of ok.J, err.J, rtt.J, or measurements that are empty where they were lost",
        )
    parts = [_part(run, joints) for run in runs]
    start, times = 0.0, []
    for part in parts:
        times.append(part["t"] - part["t"][0] + start)
        part["cmd_t"] = part["cmd_t"] - part["t"][0] + start
        start = float(times[-1][-1]) + 1.0
    steps = np.concatenate([part.pop("steps") for part in parts])
    facts = tuple(_bus_facts(run) for run in runs)
    chain = next((one["chain"] for one in facts if one.get("chain")), ())
    together = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "t"}
    return BusLog(
        joints=joints,
        names=tuple(run.name for run in runs),
        t=np.concatenate(times),
        run=np.repeat(np.arange(len(runs)), [len(part["t"]) for part in parts]),
        period_s=float(np.median(steps)) if len(steps) else 0.02,
        chain=tuple(cable for cable in (tuple(str(j) for j in one if j in joints) for one in chain) if cable),
        ids=next((one["ids"] for one in facts if one.get("ids")), {}),
        baud=np.array([float(one.get("baud") or np.nan) for one in facts]),
        facts=facts,
        **together,
    )


def _bus_facts(run: Run) -> Mapping[str, Any]:
    extra = dict(run.facts.extra)
    chain = extra.get("chain")
    if chain and all(isinstance(one, str) for one in chain):  # one cable for all, written flat
        extra["chain"] = [chain]
    elif not isinstance(chain, (list, tuple)) or not all(isinstance(one, (list, tuple)) for one in chain):
        extra["chain"] = ()
    ids = extra.get("ids")
    if not isinstance(ids, Mapping) or not all(type(one) is int for one in ids.values()):
        extra["ids"] = {}
    for name in ("baud", "latency_timer_ms", "return_delay_s"):
        value = extra.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            extra.pop(name, None)
    return extra


def _tells(run: Run, joint: str) -> bool:
    return any(f"{signal}.{joint}" in run.columns for signal in ("ok", "err", *_MEASURED))


def _numbers(run: Run, signal: str, joint: str) -> Array:
    column = run.columns.get(f"{signal}.{joint}")
    if column is None or column.dtype.kind in "OU":
        return np.full(len(run.t), np.nan)
    return np.asarray(column, float)


def _losses(run: Run, joint: str) -> tuple[Flags, NDArray[np.int8]]:
    """(asked, code of the word) of one joint's rows."""
    n = len(run.t)
    words = np.zeros(n, np.int8)
    asked = np.ones(n, bool)
    known = False
    said = run.columns.get(f"err.{joint}")
    if said is not None and said.dtype.kind in "OU":
        raw = np.array(["" if one is None else str(one) for one in said.tolist()], dtype=object)
        for written in {*raw.tolist()}:
            word = written.strip().lower()
            code = 0 if word in ("", "alert", "nan", "none", "ok") else _CODE.get(word, _CODE["lost"])
            words[raw == written] = code
        known = True
    ok = _numbers(run, "ok", joint)
    if np.isfinite(ok).any():
        words[(ok == 0) & (words == 0)] = _CODE["lost"]
        if f"err.{joint}" not in run.columns or not known:
            asked = np.isfinite(ok)
        known = True
    if known:
        return asked, words
    measured = [_numbers(run, signal, joint) for signal in _MEASURED if f"{signal}.{joint}" in run.columns]
    measured = [values for values in measured if np.isnan(values).mean() < _SPARSE]
    if not measured:
        return np.zeros(n, bool), words
    words[np.isnan(np.array(measured)).all(axis=0)] = _CODE["lost"]
    return asked, words


def _filled(t: Array, values: Array, command: Array) -> Array:
    """Values with gaps filled: by what the command does to them, where that is there and foretells them, else straight.

    A joint whose wire breaks at an angle never shows that angle: only its command still tells.
    """
    good = np.isfinite(values)
    if good.all():
        return values
    if not good.any():
        return np.where(np.isfinite(command), command, np.nan)
    filled = np.interp(t, t[good], values[good])
    # While torque is off nobody commands anything, and the joint does what it likes.
    told = np.isfinite(command)
    both = good & told
    if both.sum() > _FEWEST and np.ptp(command[told]) > 0:
        whole = np.interp(t, t[told], command[told])
        scatter, best = 0.3 * float(np.var(values[both])), None
        for lag_s in _LAGS_S:
            follows = _lagged(t, whole, lag_s)
            fit = np.polyfit(follows[both], values[both], 1) if np.ptp(follows[both]) > 0 else np.zeros(2)
            left = float(np.var(values[both] - np.polyval(fit, follows[both])))
            if left < scatter:
                scatter, best = left, np.polyval(fit, follows)
        if best is not None:
            filled = np.where(told, best, filled)
    return np.where(good, values, filled)


def _lagged(t: Array, command: Array, lag_s: float) -> Array:
    """A command behind a first-order lag, its rows taken as evenly spaced."""
    if lag_s <= 0:
        return command
    from scipy.signal import lfilter  # a second to load

    keep = float(np.exp(-float(np.median(np.diff(t))) / lag_s))
    out: Array = lfilter([1 - keep], [1, -keep], command - command[0]) + command[0]
    return out


def _part(run: Run, joints: Sequence[str]) -> dict[str, Any]:
    t, n = run.t, len(run.t)
    steps, weight = np.diff(t), np.ones(n)
    rate = run.facts.extra.get("rate_hz")
    if "thinned_s" in run.facts.extra and isinstance(rate, int | float) and rate > 0:
        # A soak keeps few of its healthy cycles; each stands for those left out before it.
        kept = float(run.facts.extra["thinned_s"])
        weight[1:] = np.where(steps < 1.5 * kept + 1 / rate, np.maximum(1.0, np.round(steps * rate)), 1.0)
        steps = np.full(1, 1 / rate)
    losses = [
        _losses(run, joint) if joint in run.joints else (np.zeros(n, bool), np.zeros(n, np.int8)) for joint in joints
    ]
    asked = np.stack([one[0] for one in losses], axis=1)
    word = np.stack([one[1] for one in losses], axis=1)
    word[~asked] = 0
    signals = {
        name: np.stack([_numbers(run, name, joint) for joint in joints], axis=1) for name in ("rtt", "volt", "tick")
    }
    angle, efforts, speeds = np.full((n, len(joints)), np.nan), [], []
    for k, joint in enumerate(joints):
        cmd = _numbers(run, "cmd", joint)
        angle[:, k] = _filled(t, _numbers(run, "pos", joint), cmd)
        vel = _numbers(run, "vel", joint)
        if np.isfinite(vel).any():
            speeds.append(np.abs(_filled(t, vel, np.full(n, np.nan))))
        elif np.isfinite(angle[:, k]).all() and n > 2:
            speeds.append(np.abs(_speed(t, angle[:, k])))
        for name in ("cur", "load", "pwm"):
            effort = _numbers(run, name, joint)
            if np.isfinite(effort).mean() > 1 - _SPARSE:
                efforts.append((name, np.abs(_filled(t, effort, np.full(n, np.nan)))))
                break
        else:
            if np.isfinite(cmd).all() and np.isfinite(angle[:, k]).all():
                efforts.append(("error", np.abs(cmd - angle[:, k])))
    # Amperes and shares of full load are not one unit: each kind is brought to its own scale first.
    load = np.zeros(n) if efforts else np.full(n, np.nan)
    for kind in {kind for kind, _ in efforts}:
        total = np.sum([effort for one, effort in efforts if one == kind], axis=0)
        load += total / max(float(np.nanpercentile(total, 90)), 1e-9)
    body = np.stack([run.column(f"{kind}.{axis}") for kind in ("gyro", "acc") for axis in "xyz"], axis=1)
    return {
        "t": t,
        "lost": word > 0,
        "asked": asked,
        "word": word,
        **signals,
        "angle": angle,
        "speed": np.sum(speeds, axis=0) if speeds else np.full(n, np.nan),
        "load": load,
        "shake": _shaking(t, body),
        "weight": weight,
        "steps": steps,
        "wake": run.column("wake"),
        "cmd_t": run.column("cmd_t"),
    }


def _speed(t: Array, angle: Array) -> Array:
    """(n,) rad/s. Rows that a late loop catches up with follow each other at once: they count as half a period apart."""
    step = np.gradient(t)
    speed: Array = np.gradient(angle) / np.maximum(step, 0.5 * float(np.median(step)))
    return speed


def _shaking(t: Array, body: Array) -> Array:
    """(n,) how much the torso shakes: step to step changes of what its IMU reads, each axis to its own scale."""
    out = np.full(len(t), np.nan)
    columns = [
        _filled(t, column, np.full(len(t), np.nan)) for column in body.T if np.isfinite(column).mean() > 1 - _SPARSE
    ]
    if columns and len(t) > 2:
        jumps = [np.abs(np.diff(column, prepend=column[0])) for column in columns]
        out = np.sum([jump / max(float(np.percentile(jump, 95)), 1e-12) for jump in jumps], axis=0)
    return out
