"""Soaks as run tables, written column by column: a second opinion on what faults look like.

Nothing here runs a servo's firmware or any packet: motion, load, supply, round trips and the host's clock are drawn in
forms of their own, other than the virtual robot's, and the fault is laid over them. Losses of a few in a hundred
thousand answers, a host that is late by some ms, and a supply that gives a little under load belong to a healthy bus.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from openant_tools.blind.soaks import SoakAnswer
from openant_tools.recording.run import Facts, Run

__all__ = ["soak_table"]

Array = NDArray[np.float64]
_ANSWER_BYTES, _REQUEST_BYTES = 38, 22


def soak_table(answer: SoakAnswer, name: str) -> Run:
    """The log of one soak."""
    return _Soak(answer).run(name)


class _Soak:
    """Signals of a healthy robot, then the fault."""

    def __init__(self, answer: SoakAnswer) -> None:
        self.answer, self.p = answer, answer.parameters
        self.chance = np.random.default_rng(answer.seed)
        self.n, self.j = int(answer.seconds * answer.rate_hz), len(answer.joints)
        self.t = np.arange(self.n) / answer.rate_hz
        self.lost = np.zeros((self.n, self.j), bool)
        self.word = np.full((self.n, self.j), "", dtype=object)
        self._clock()
        self._move()
        self._power()
        self._round_trips()
        self._background()
        getattr(self, f"_{answer.cause}", lambda: None)()

    # ---- a healthy robot ----

    def _clock(self) -> None:
        chance, n = self.chance, self.n
        self.wake = np.abs(chance.normal(0, 2e-4, n)) + chance.exponential(1e-4, n)
        rare = chance.random(n) < chance.uniform(0, 2e-3)
        self.wake[rare] += chance.exponential(4e-3, rare.sum())
        self.wake = np.minimum(self.wake, 0.018)
        self.cmd_gap = np.full(n, 1e-3) if chance.random() < 0.5 else chance.uniform(0.4e-3, 1.6e-3, n)
        self.tick0 = chance.uniform(0, 32768, self.j)
        self.restarted = np.full((n, self.j), np.nan)

    def _move(self) -> None:
        chance, n, j, t = self.chance, self.n, self.j, self.t
        kind = chance.integers(3)
        middle = np.where([name.startswith("hip") for name in self.answer.joints], 0.0, -0.8)
        reach = chance.uniform(0.15, 0.5, j)
        if kind == 0:  # a gait
            hz = chance.uniform(0.4, 1.8)
            cmd = middle + reach * np.sin(2 * np.pi * hz * t[:, None] + chance.uniform(0, 2 * np.pi, j))
        elif kind == 1:  # an agent's steps
            hold = max(1, round(0.12 * self.answer.rate_hz))
            steps = chance.uniform(-1, 1, (n // hold + 2, j))
            cmd = middle + reach * np.repeat(steps, hold, axis=0)[:n]
        else:  # many sines, with pauses
            each, phases = chance.uniform(0.1, 2.5, (j, 4)), chance.uniform(0, 2 * np.pi, (j, 4))
            cmd = middle + reach / 2 * np.sin(2 * np.pi * each * t[:, None, None] + phases).sum(axis=2)
            pause = (np.floor(t / 20) % 4) == 3
            cmd[pause] = middle
        self.cmd = cmd
        lag = np.exp(-1 / (self.answer.rate_hz * 0.06))
        pos = lfilter([1 - lag], [1, -lag], cmd - cmd[0], axis=0) + cmd[0]
        self.pos = pos + chance.normal(0, 7e-4, pos.shape)
        self.vel = np.gradient(pos, t, axis=0)
        accel = np.gradient(self.vel, t, axis=0)
        weight = chance.uniform(0.1, 0.5)
        self.current = (
            0.03 + weight * np.abs(np.cos(self.pos)) + 0.05 * np.abs(self.vel) + np.minimum(0.012 * np.abs(accel), 1.2)
        )
        self.current = np.abs(self.current + chance.normal(0, 0.015, pos.shape))

    def _power(self) -> None:
        chance = self.chance
        self.volts = chance.uniform(11.6, 12.5)
        self.ohm = chance.uniform(0.02, 0.22)
        self.sum_a = self.current.sum(axis=1)
        self.sum_a *= chance.uniform(1.2, 2.4) / self.sum_a.mean()
        if self.answer.cause == "supply_weak":
            self.ohm = self.p["drop_v"] / (np.quantile(self.sum_a, 0.99) - np.quantile(self.sum_a, 0.1))
        # Under what every load draws, a weak supply is low all the time; how low is in `volts`.
        self.bus_v = self.volts - self.ohm * (self.sum_a - 0.8 * np.quantile(self.sum_a, 0.1))
        self.volt = self.bus_v[:, None] - chance.uniform(0, 0.06, self.j) * self.current
        self.volt += chance.normal(0, 0.04, self.volt.shape)

    def _round_trips(self) -> None:
        byte_s = 10 / self.answer.baud
        ends = _REQUEST_BYTES * byte_s + byte_s * _ANSWER_BYTES * np.arange(1, self.j + 1)
        usb = self.chance.gamma(4, 8e-5, (self.n, 1))
        self.rtt = ends[None, :] + usb + self.chance.normal(0, 8e-6, (self.n, self.j))
        if self.chance.random() < 0.5:  # a timer of 1 ms hands over by the ms
            phase = self.chance.uniform(0, 1e-3, (self.n, 1))
            self.rtt = np.ceil((self.rtt + phase) / 1e-3) * 1e-3 - phase

    def _background(self) -> None:
        share = self.chance.choice([0.0, 1e-6, 1e-5, 4e-5])
        self._lose(self.chance.random(self.lost.shape) < share, "timeout", 0.5)

    # ---- what goes wrong ----

    def _lose(self, hit: NDArray[np.bool_], word: str, broken: float = 0.0, other: str = "crc") -> None:
        """Losses of one word, a share of them of another."""
        self.lost |= hit
        words = np.where(self.chance.random(hit.shape) < broken, other, word)
        self.word[hit] = words[hit]

    def _columns_of(self, first: str) -> NDArray[np.int64]:
        """Servos behind the cable that leads to `first`, it included."""
        for cable in self.answer.chain:
            if first in cable:
                return np.array([self.answer.joints.index(name) for name in cable[cable.index(first) :]])
        return np.array([self.answer.joints.index(first)])

    def _span(self, start: float, seconds: float) -> NDArray[np.bool_]:
        flags: NDArray[np.bool_] = (self.t >= start) & (self.t < start + seconds)
        if not flags.any():
            # Shorter than a row: whoever is asked in that moment.
            k = int(np.searchsorted(self.t, start))
            if k < self.n and self.chance.random() < max(0.35, seconds * self.answer.rate_hz):
                flags[k] = True
        return flags

    def _power_off(self, rows: NDArray[np.bool_], joints: NDArray[np.int64], seconds: float) -> None:
        """Servos that lose their supply: silent, and anew after a while where it lasted."""
        if not rows.any():
            return
        first, last = np.flatnonzero(rows)[[0, -1]]
        hold_up = self.chance.uniform(0.008, 0.06)
        hit = np.zeros_like(self.lost)
        hit[np.ix_(rows, joints)] = True
        if seconds > hold_up:
            boot = self.chance.uniform(0.25, 0.5)
            end = self.t[last] + boot
            mute = (self.t > self.t[last]) & (self.t < end)
            hit[np.ix_(mute, joints)] = True
            after = np.flatnonzero(self.t >= end)
            if len(after):
                self.restarted[np.ix_(after, joints)] = self.t[last]
                last = after[0]
        else:
            last = min(self.n - 1, last + 1)
        self._lose(hit, "timeout", 0.12, "short")
        depth = self.chance.uniform(0.6, 4.0)
        if self.chance.random() < 0.8:
            self.volt[last, joints] -= depth * self.chance.uniform(0.4, 1.0)
        if first and self.chance.random() < 0.6:
            self.volt[first - 1, joints] -= depth * self.chance.uniform(0.3, 1.0)

    def _power_connector(self) -> None:
        p, chance = self.p, self.chance
        joints = self._columns_of(self.answer.where[0]) if self.answer.where else np.arange(self.j)
        shaking = np.abs(self.vel).sum(axis=1) ** p["by_motion"] + 1e-9
        count = max(2, int(chance.poisson(p["a_minute"] * self.answer.seconds / 60)))
        for k in chance.choice(self.n, size=count, p=shaking / shaking.sum()):
            seconds = p["open_s"] * chance.lognormal(0, 0.5)
            start = self.t[k] + chance.uniform(0, 1 / self.answer.rate_hz)
            rows = self._span(start, seconds)
            rows[k] |= chance.random() < 0.7
            self._power_off(rows, joints, seconds)

    def _supply_weak(self) -> None:
        """Below a voltage that a few percent of the time reach, servos stop hearing."""
        smooth = np.convolve(self.bus_v, np.ones(2) / 2, "same")
        edge = float(np.quantile(smooth, self.p["share"]))
        own = self.chance.normal(0, 0.08, self.j)
        low = smooth[:, None] < edge + own
        self._lose(low & (self.chance.random(low.shape) < 0.85), "timeout", 0.1, "short")
        deep = smooth < float(np.quantile(smooth, self.p["share"] / 6))
        if self.chance.random() < 0.6:
            for k in np.flatnonzero(deep)[::20][:30]:
                self._power_off(self._span(self.t[k], 0.02), np.arange(self.j), 1.0)

    def _broken_wire(self) -> None:
        p, joint = self.p, self.answer.joints.index(self.answer.where[0])
        q = self.pos[:, joint]
        edge = float(np.quantile(q, 1 - p["share"] if p["above"] else p["share"]))
        open_ = (q > edge) if p["above"] else (q < edge)
        open_ &= self.chance.random(self.n) >= p["flicker"]
        hit = np.zeros_like(self.lost)
        hit[np.ix_(open_, self._columns_of(self.answer.where[0]))] = True
        self._lose(hit, "timeout", self.chance.uniform(0, 0.3), "short")

    def _bursts(self, fraction: float) -> NDArray[np.bool_]:
        """(n,) good and bad spells, `fraction` of the rows bad."""
        if not self.p["bursts"]:
            return self.chance.random(self.n) < fraction
        length = self.chance.uniform(2, 12)
        bad, state = np.zeros(self.n, bool), False
        enter = fraction / max(1 - fraction, 1e-3) / length
        luck = self.chance.random(self.n)
        for k in range(self.n):
            state = luck[k] > 1 / length if state else luck[k] < enter
            bad[k] = state
        return bad

    def _bad_servo(self) -> None:
        hit = np.zeros_like(self.lost)
        hit[:, self.answer.joints.index(self.answer.where[0])] = self._bursts(self.p["fraction"])
        self._lose(hit, "timeout", self.p["broken"])

    def _bad_cable(self) -> None:
        hit = np.zeros_like(self.lost)
        hit[np.ix_(self._bursts(self.p["fraction"]), self._columns_of(self.answer.where[0]))] = True
        self._lose(hit, "timeout", 0.5 * self.p["broken"], "short")

    def _line_noise(self) -> None:
        p = self.p["byte_error"] * (self.answer.baud / 1e6) ** 0.5
        request = self.chance.random(self.n) < 1 - (1 - p) ** _REQUEST_BYTES
        self._lose(np.repeat(request[:, None], self.j, axis=1), "timeout")
        answers = self.chance.random(self.lost.shape) < 1 - (1 - p) ** _ANSWER_BYTES
        self._lose(answers, "crc", 0.15, "short")

    def _return_delay(self) -> None:
        waits = np.full(self.j, self.p["delay_s"])
        if self.p["one"]:
            waits[:] = 0.0
            waits[self.chance.integers(1, self.j)] = max(self.p["delay_s"], 0.4e-3)
        ends = self.rtt + np.cumsum(waits)[None, :]
        self.rtt = ends
        if self.chance.random() < 0.4:  # the driver's deadline knows nothing of it
            late = ends > float(np.quantile(ends[:, -1], 0.97))
            self._lose(late, "late")

    def _latency_timer(self) -> None:
        timer = self.p["timer_s"]
        if self.p["locked"]:
            self.rtt = np.ceil(self.rtt / timer) * timer + self.chance.normal(0, 1.2e-4, (self.n, 1))
        else:
            phase = self.chance.uniform(0, timer)
            stamps = self.row_t[:, None] + self.rtt
            self.rtt = (np.floor((stamps - phase) / timer) + 1) * timer + phase - self.row_t[:, None]
            self.rtt += self.chance.normal(0, 5e-5, (self.n, 1))
        if self.p["lossy"]:
            late = (self.rtt > 0.75 * timer) & (self.chance.random((self.n, 1)) < 0.03)
            self._lose(late, "late")

    def _host_stall(self) -> None:
        p, chance = self.p, self.chance
        at = p["every_s"]
        while at < self.answer.seconds:
            k = int(at * self.answer.rate_hz)
            if k < self.n:
                late = p["for_s"] * chance.uniform(0.6, 1.4)
                self.wake[k] = late
                rest = self.wake[k + 1 : k + 1 + int(late * self.answer.rate_hz)]
                rest[:] = np.maximum(rest, late - np.arange(1, len(rest) + 1) / self.answer.rate_hz)
                if p["lossy"] and chance.random() < 0.5:
                    hit = np.zeros_like(self.lost)
                    hit[k] = True
                    self._lose(hit, "late" if chance.random() < 0.6 else "timeout")
            at += p["every_s"] if p["periodic"] else chance.exponential(p["every_s"])

    def _usb_unplug(self) -> None:
        for _ in range(self.p["times"]):
            start = self.chance.uniform(0.05, 0.85) * self.answer.seconds
            rows = self._span(start, self.p["for_s"])
            self._lose(np.repeat(rows[:, None], self.j, axis=1), "port" if self.p["word"] else "timeout")

    def _duplicate_id(self) -> None:
        p = self.p
        a, b = (self.answer.joints.index(name) for name in self.answer.where)
        both = self.chance.random(self.n) < p["share"]
        hit = np.zeros_like(self.lost)
        hit[both, a] = True
        self._lose(hit, "crc", 0.25, "short")
        other = np.zeros_like(self.lost)
        if p["form"] == 0:  # nobody has the other id any more
            other[:, b] = True
            self._lose(other, "timeout")
        else:
            other[both if p["form"] == 1 else self.chance.random(self.n) < p["share"], b] = True
            self._lose(other, "crc", 0.2, "short")

    def _write_read_gap(self) -> None:
        p, chance, n = self.p, self.chance, self.n
        if p["form"] == 0:  # the gap varies with the host
            self.cmd_gap = chance.uniform(0.02e-3, 3 * p["needed_s"], n)
            deaf = self.cmd_gap < p["needed_s"]
        else:  # a write every so many reads
            self.cmd_gap = np.abs(chance.normal(0.4, 0.03, n)) * p["needed_s"]
            self.write_every = int(chance.integers(2, 6))
            deaf = np.arange(n) % self.write_every == 0
        deaf &= chance.random(n) < chance.uniform(0.75, 1.0)
        self._lose(np.repeat(deaf[:, None], self.j, axis=1), "timeout")

    # ---- the log ----

    write_every = 1

    @property
    def row_t(self) -> Array:
        times: Array = self.t + self.wake
        return np.maximum.accumulate(times + 1e-5 * np.arange(self.n) / self.n)

    def run(self, name: str) -> Run:
        answer, chance = self.answer, self.chance
        t = self.row_t
        t = np.maximum.accumulate(t) + 1e-6 * np.arange(self.n)
        columns: dict[str, NDArray[Any]] = {}
        tick = (t[:, None] * 1e3 + self.tick0) % 32768
        anew = np.isfinite(self.restarted)
        tick[anew] = ((t[:, None] - self.restarted) * 1e3)[anew] % 32768
        signals = {
            "pos": self.pos, "vel": self.vel, "volt": np.round(np.maximum(self.volt, 5.0), 1), "tick": np.floor(tick),
            "temp": np.round(34 + 0.01 * t[:, None] + chance.uniform(-2, 2, self.j)), "rtt": self.rtt,
            "pwm": np.clip(0.1 + 0.2 * self.current, 0, 1),
        }  # fmt: skip
        for k, joint in enumerate(answer.joints):
            columns[f"cmd.{joint}"] = self.cmd[:, k]
            effort, values = ("cur", self.current) if joint.startswith("knee") else ("load", self.current / 2)
            for signal, table in {**signals, effort: values}.items():
                measured = np.asarray(table[:, k], float).copy()
                keep_late = signal == "rtt"
                gone = self.lost[:, k] & ~(keep_late & (self.word[:, k] == "late"))
                measured[gone] = np.nan
                columns[f"{signal}.{joint}"] = np.clip(measured, None, 1.0) if signal == "load" else measured
            columns[f"ok.{joint}"] = 1.0 - self.lost[:, k]
            columns[f"err.{joint}"] = self.word[:, k]
        columns["wake"] = self.wake
        cmd_t = t - self.cmd_gap
        sent = np.arange(self.n) % self.write_every == 0
        columns["cmd_t"] = cmd_t[np.maximum.accumulate(np.where(sent, np.arange(self.n), 0))]
        columns = {
            column: values for column, values in columns.items() if column.partition(".")[0] not in answer.dropped
        }
        extra: dict[str, Any] = {"baud": answer.baud, "latency_timer_ms": 1.0, "return_delay_s": 0.0}
        if answer.chain_told:
            extra["chain"] = [list(cable) for cable in answer.chain]
        for fact in ("latency_timer_ms", "return_delay_s"):
            if answer.cause in ("latency_timer", "return_delay") or chance.random() < 0.3:
                extra.pop(fact)  # whoever knew it would not ask
        return Run(name, Facts(joints=answer.joints, setup="stand", extra=extra), t, columns)
