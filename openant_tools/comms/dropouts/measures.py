"""What a log shows, as numbers between 0 and 1: one function a physical mark, each with the words to say it.

None of them knows causes. A measure that the log has no columns for is absent, and then says nothing for or against.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.dropouts.episodes import DropoutEpisode, Reach, episodes_of, reach_of
from openant_tools.comms.dropouts.log import WORDS, Array, BusLog, Flags
from openant_tools.numbers import number, percent

__all__ = ["Measure", "Measures", "measure"]

#: V, below what goes as noise and resolution (0.1 V) of a servo's own reading
DIP_V = 0.35
#: V by which a load pulls the supply down where that is worth mentioning, for the scale of `sag`
SAG_V = 1.5
#: rows looked at around an episode
NEAR = 2
#: s, a loop that begins later than this has stood still; operating systems do 10 ms now and then
STALL_S = 0.02
#: ms, a tick further from where it should be has begun anew
RESET_MS = 120.0
#: s, of waiting beyond the wire where a latency timer is felt
COMB_WAIT_S = 2.5e-3
#: share of a comb from which on answers count as handed over by its timer
BEATS = 0.5
#: s, USB hands over in frames of it, timers count in it; share of steps that are whole ones where answers come so
TICK_S, IN_TICKS = 1e-3, 0.6
#: s, parts of a timer's period, of which each has so much of its share where reads begin at all phases alike
PHASE_S, EVEN = 0.1e-3, 0.6
#: bytes that the longest block read of ours is long on the wire, with its frame
LONGEST_ANSWER = 38
#: episodes a minute where `often` begins; a thousand times as many are as often as can be
SELDOM = 0.1
#: V, servos for a nominal 12 V need so much (facts/dynamixel: XM430 and XC430 10.0 V); a robot that ever reads more than
#: the other has such
NEEDED_V, TWELVE_VOLT = 10.0, 9.0
#: times that losses are moved elsewhere, to see what chance does; closer together than this (s) they move as one
SHIFTS, CLUSTER_S = 30, 0.25
#: loops tell nothing of a mark in fewer rows
FEWEST = 20


@dataclass(frozen=True)
class Measure:
    """One mark: `value` in 0…1, and a sentence with the physical quantity."""

    value: float
    words: str


@dataclass(frozen=True)
class Measures:
    """Everything seen in one log.

    Attributes:
        marks: name → measure; a name is absent where the log cannot tell.
        losses: "no", "stray" (a few, of no pattern) or "yes".
        at: name of a mark → joints by position that it was strongest at.
    """

    log: BusLog
    episodes: list[DropoutEpisode]
    reach: Reach
    losses: str
    marks: Mapping[str, Measure]
    at: Mapping[str, tuple[int, ...]]


def measure(log: BusLog) -> Measures:
    """Look at everything that the log has columns for."""
    episodes, reach = episodes_of(log), reach_of(log)
    marks: dict[str, Measure] = {}
    at: dict[str, tuple[int, ...]] = {}
    looks: Sequence[Callable[..., Iterator[tuple[str, Measure, tuple[int, ...]]]]] = (
        _words, _extent, _rhythm, _dips, _empty, _sag, _resets, _explained, _host, _comb, _staircase, _gap, _baud,
    )  # fmt: skip
    for look in looks:
        for name, seen, joints in look(log, episodes, reach):
            if math.isfinite(seen.value):
                marks[name] = Measure(min(1.0, max(0.0, seen.value)), seen.words)
                at[name] = joints
    return Measures(log, episodes, reach, _kind_of_losses(log, episodes, reach, marks), marks, at)


Look = Iterator[tuple[str, Measure, tuple[int, ...]]]


def _kind_of_losses(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach, marks: Mapping[str, Measure]) -> str:
    if not episodes:
        return "no"
    lost, asked = int(log.lost.sum()), max(1, int(log.answers.sum()))
    rows = int(log.lossy.sum())
    told = any(marks[name].value > 0.3 for name in ("dip", "reset", "port") if name in marks)
    longest = max(one.stop - one.start for one in episodes)
    if told or longest > 2:
        return "yes"
    wholes = sum(len(one.joints) > 1 for one in episodes)
    if rows <= 2:
        return "stray"
    # Background of a healthy bus: single answers, here and there, not again and again from one servo.
    top = float(log.lost.sum(axis=0).max())
    even = lost / max(1, len(log.joints))
    concentrated = top > even + 3 * math.sqrt(even) + 2
    few = lost < 2.5e-4 * asked and wholes <= 2
    return "stray" if few and not concentrated else "yes"


def _words(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    if not episodes:
        return
    codes = log.word[log.word > 0]
    counts = {word: int((codes == k).sum()) for k, word in enumerate(WORDS) if k}
    said = sum(counts.values()) - counts["lost"]
    if said < 0.3 * len(codes):
        return
    broken = (counts["crc"] + counts["short"]) / said
    yield "crc", Measure(broken, f"{percent(broken)} of what was lost came broken"), ()
    yield "late", Measure(counts["late"] / said, f"{percent(counts['late'] / said)} of what was lost came too late"), ()
    yield (
        "port",
        Measure(counts["port"] / said, f"the host's port was gone in {percent(counts['port'] / said)} of losses"),
        (),
    )


def _extent(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    if not episodes:
        return
    names = [log.joints[k] for k in reach.joints]
    whom = "all servos" if reach.kind == "all" else ", ".join(names)
    if len(reach.joints) > 1:
        yield (
            "together",
            Measure(reach.together, f"a read that loses any of {whom} loses {percent(reach.together)} of them"),
            reach.joints,
        )
    rate = float(reach.rate[list(reach.joints)].mean())
    yield "rate", Measure(rate, f"{percent(rate, decimals=2)} of the answers of {whom} are lost"), reach.joints


def _rhythm(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    if not episodes:
        return
    runs = _lengths(np.asarray(reach.lost.any(axis=1), bool))
    # By reads, not by losses: a stray one or two must not outnumber an outage of a thousand reads.
    single = float((runs <= 1).sum() / runs.sum())
    yield "single", Measure(single, f"{percent(single)} of the reads that lose anything stand alone"), ()
    a_minute = len(episodes) / max(log.seconds / 60, 1e-3)
    often = math.log10(max(a_minute, SELDOM) / SELDOM) / 3
    yield "often", Measure(often, f"it happens {len(episodes)} times, {number(a_minute)} times a minute"), ()
    longest = max(one.to_s - one.from_s for one in episodes) + log.period_s
    rows = int(log.lossy.sum())
    # The length that holds half of all lossy rows, so that one stray loss does not hide an outage.
    lengths = np.sort([one.stop - one.start for one in episodes])
    typical = float(lengths[np.searchsorted(np.cumsum(lengths), rows / 2)]) * log.period_s
    span = math.log(max(typical, 0.02) / 0.02) / math.log(10.0 / 0.02)
    yield (
        "long",
        Measure(span, f"it stays silent for {number(typical, 's')} at a time, {number(longest, 's')} at most"),
        (),
    )


def _lengths(flags: Flags) -> NDArray[np.int64]:
    """Lengths of the runs of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return np.asarray(edges[1::2] - edges[::2])


# ---- supply ----


def _supply(log: BusLog) -> Array:
    """(n,) V, the lowest that any servo reads; NaN where none does."""
    with np.errstate(invalid="ignore"):
        volts = np.where(np.isfinite(log.volt) & (log.volt > 0.5), log.volt, np.inf)
        lowest = volts.min(axis=1) if volts.shape[1] else np.full(len(log.t), np.inf)
    return np.where(np.isfinite(lowest), lowest, np.nan)


def _near(log: BusLog, episodes: Sequence[DropoutEpisode], values: Array, worst: Callable[[Array], float]) -> Array:
    """The worst of `values` around each episode; NaN where none is known."""
    out = np.full(len(episodes), np.nan)
    for k, one in enumerate(episodes):
        low, high = max(0, one.start - NEAR), min(len(log.t), one.stop + NEAR)
        seen = values[low:high][log.run[low:high] == log.run[one.start]]
        seen = seen[np.isfinite(seen)]
        if len(seen):
            out[k] = worst(seen)
    return out


def _dips(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    volts = _supply(log)
    good = np.isfinite(volts)
    if not episodes or good.sum() < FEWEST:
        return
    near: Flags = np.zeros(len(log.t), bool)
    for one in episodes:
        near[max(0, one.start - NEAR) : one.stop + NEAR] = True
    away = volts[good & ~near]
    if len(away) < FEWEST:
        away = volts[good]
    usual = float(np.median(away))
    # The lowest of a few rows of healthy running: what a window of this width shows by load alone.
    floor = min(usual - DIP_V, float(np.quantile(away, 0.01)) - 0.1)
    lowest = _near(log, episodes, volts, lambda seen: float(seen.min()))
    known = np.isfinite(lowest)
    if not known.any():
        return
    # Long silence hides what happened; episodes are weighed alike, whoever saw nothing is left out.
    share = float((lowest[known] < floor).mean())
    chance = float((away < floor).mean()) * (2 * NEAR + 1)
    deep = usual - float(np.min(lowest[known]))
    low = np.isfinite(log.volt) & (log.volt < floor) & near[:, None]
    joints = tuple(np.flatnonzero(low.any(axis=0)).tolist())
    words = f"the supply dips at {percent(share)} of the losses, by {number(deep, 'V', decimals=1)} at most (usual {number(usual, 'V', decimals=1)})"
    yield "dip", Measure(max(0.0, share - chance), words), joints


def _empty(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """Whether the supply, with next to no load on it, is below what servos need: they begin anew again and again."""
    volts = _supply(log)
    known = volts[np.isfinite(volts)]
    if len(known) < FEWEST or float(known.max()) < TWELVE_VOLT:
        return
    usual = float(np.median(known))
    value = 1 / (1 + math.exp(min((usual - NEEDED_V) / 0.15, 50.0)))
    yield (
        "empty",
        Measure(value, f"the supply stands at {number(usual, 'V', decimals=1)}, servos need {number(NEEDED_V, 'V')}"),
        (),
    )


def _sag(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(log.volt)
        volts = np.where(seen, log.volt, 0.0).sum(axis=1) / seen.sum(axis=1)
    good = np.isfinite(volts) & np.isfinite(log.load)
    if good.sum() < FEWEST:
        return
    v, x = volts[good], log.load[good]
    spread = float(np.quantile(x, 0.98) - np.quantile(x, 0.05))
    if x.std() < 1e-9 or v.std() < 1e-9:
        yield "sag", Measure(0.0, "the supply does not move with the load"), ()
        return
    slope = float(np.cov(x, v)[0, 1] / x.var())
    r = float(np.corrcoef(x, v)[0, 1])
    drop = max(0.0, -slope) * spread * min(1.0, r * r / 0.25)
    yield (
        "sag",
        Measure(
            drop / SAG_V,
            f"full load pulls the supply down by {number(drop, 'V', decimals=2)} (correlation {number(r, decimals=2)})",
        ),
        (),
    )


def _resets(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    restarts = np.zeros(log.lost.shape, bool)
    usable = False
    for k in range(len(log.joints)):
        rows = np.flatnonzero(np.isfinite(log.tick[:, k]))
        if len(rows) < FEWEST:
            continue
        same = log.run[rows[1:]] == log.run[rows[:-1]]
        expected = np.diff(log.t[rows]) * 1e3
        passed = np.diff(log.tick[rows, k]) % 32768
        off = np.abs((passed - expected + 16384) % 32768 - 16384)
        if np.median(off[same]) > RESET_MS / 3 if same.any() else True:
            continue  # no clock in ms, whatever it is
        usable = True
        # A servo that began anew counts from zero: its tick cannot be older than the time since it was last heard.
        young = log.tick[rows[1:], k] <= expected + 500.0
        hit = same & (off > RESET_MS + 0.02 * expected) & young
        restarts[rows[1:][hit], k] = True
    if not usable or not episodes:
        return
    after = np.zeros(len(episodes))
    for n, one in enumerate(episodes):
        high = min(len(log.t), one.stop + 2 * NEAR)
        after[n] = restarts[one.start : high].any()
    share = float(after.mean())
    # One outage of many belongs to the same power failure: weighed by rows, too, since those take longest.
    rows = np.array([one.stop - one.start for one in episodes], float)
    by_rows = float((after * rows).sum() / rows.sum())
    joints = tuple(np.flatnonzero(restarts.any(axis=0)).tolist())
    names = "all servos" if len(joints) == len(log.joints) else ", ".join(log.joints[k] for k in joints) or "no servo"
    words = f"realtime ticks of {names} begin anew at {percent(share)} of the losses"
    yield "reset", Measure(max(share, by_rows), words), joints


# ---- what the moments of loss have in common ----


def _explained(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """How much of the timing of losses an angle, the load or shaking explains, beyond what chance does."""
    lossy = np.asarray(reach.lost.any(axis=1), bool)
    if not episodes or lossy.mean() > 0.97:
        return
    # A long silence says what it began with; every row of it would say the same again.
    weight = np.zeros(len(log.t))
    for one in episodes:
        weight[one.start : one.stop] = 1.0 / min(one.stop - one.start, 5) * (lossy[one.start : one.stop] > 0)
    starts = np.zeros(len(log.t))
    starts[[one.start for one in episodes]] = 1.0
    shifts = _elsewhere(log, episodes)
    lines = [
        (k, sign)
        for k in range(len(log.joints))
        if np.isfinite(log.angle[:, k]).all() and np.ptp(log.angle[:, k]) > 0.02
        for sign in (1.0, -1.0)
    ]
    if lines:
        # Of many lines one fits by chance: all of them are given that chance.
        value, n, edge = _half_lines([sign * log.angle[:, k] for k, sign in lines], weight, shifts, log.weight)
        k, sign = lines[n]
        side = f"{'above' if sign > 0 else 'below'} {number(sign * edge, 'rad')}"
        yield (
            "angle",
            Measure(value, f"the angle of {log.joints[k]} ({side}) explains {percent(value)} of when it is lost"),
            (k,),
        )
    volts = _supply(log)
    known = np.isfinite(volts)
    if known.sum() > FEWEST and np.ptp(volts[known]) > 0.15:
        # Of what a lost read would have shown, its neighbours know the most.
        low = -np.minimum(np.interp(log.t, log.t[known], volts[known]), _around(volts))
        value, edge = _half_line(low, starts, shifts, log.weight)
        yield (
            "low",
            Measure(
                value, f"a supply below {number(-edge, 'V', decimals=1)} explains {percent(value)} of when it is lost"
            ),
            (),
        )
    if np.isfinite(log.load).all() and np.ptp(log.load) > 1e-6:
        value, _ = _half_line(log.load, starts, shifts, log.weight)
        yield (
            "load",
            Measure(value, f"high load of all servos together explains {percent(value)} of when it is lost"),
            (),
        )
    values = []
    for signal in (log.speed, log.shake):
        if np.isfinite(signal).all() and np.ptp(signal) > 1e-6:
            values.append(_half_line(signal, starts, shifts, log.weight)[0])
    if values:
        value = max(values)
        yield "motion", Measure(value, f"fast motion explains {percent(value)} of when it is lost"), ()


def _around(values: Array) -> Array:
    """(n,) the least of each row and its neighbours, infinity where none of them knows."""
    known = np.where(np.isfinite(values), values, np.inf)
    padded = np.r_[np.inf, known, np.inf]
    least: Array = np.minimum(np.minimum(padded[:-2], padded[2:]), known)
    return least


def _elsewhere(log: BusLog, episodes: Sequence[DropoutEpisode]) -> NDArray[np.int64]:
    """(SHIFTS, n) rows by which each row's losses are moved to another time, those close together as one."""
    random = np.random.default_rng(len(log.t))
    n = len(log.t)
    moves = np.zeros((SHIFTS, n), np.int64)
    first = 0
    for k, one in enumerate(episodes):
        if k + 1 < len(episodes) and episodes[k + 1].from_s - one.to_s < CLUSTER_S:
            continue
        moves[:, episodes[first].start : one.stop] = random.integers(0, n, (SHIFTS, 1))
        first = k + 1
    return moves


def _half_line(values: Array, weight: Array, shifts: NDArray[np.int64], duration: Array) -> tuple[float, float]:
    """`_half_lines` of one signal: (value, edge)."""
    value, _, edge = _half_lines([values], weight, shifts, duration)
    return value, edge


def _half_lines(
    signals: Sequence[Array], weight: Array, shifts: NDArray[np.int64], duration: Array
) -> tuple[float, int, float]:
    """(c − o)/(1 − o) of the best region `signal ≥ edge`, less what chance reaches; which signal, and its edge.

    c is the share of losses in the region, o the share of the time (`duration`, (n,), of each row). Chance is the same losses at other times.
    """
    rows = np.flatnonzero(weight)
    total, n = float(weight.sum()), len(weight)
    if total <= 0:
        return 0.0, 0, 0.0
    best, which, at, chance = -1.0, 0, 0.0, np.zeros(len(shifts))
    for nth, values in enumerate(signals):
        edges = np.unique(np.quantile(values, np.r_[np.linspace(0.3, 0.9, 16), np.linspace(0.92, 0.995, 12)]))
        bins = np.searchsorted(edges, values, side="right")
        time = np.bincount(bins, duration, minlength=len(edges) + 1)
        # Share at or above each edge: the bins beyond it.
        o = (time[::-1].cumsum()[::-1] / time.sum())[1:]

        def gains(
            seen: NDArray[np.int64], bins: NDArray[np.int64] = bins, o: Array = o, m: int = len(edges) + 1
        ) -> Array:
            inside = (np.bincount(bins[seen], weight[rows], minlength=m)[::-1].cumsum()[::-1] / total)[1:]
            gain: Array = (inside - o) / np.maximum(1 - o, 1e-9)
            return gain

        own = gains(rows)
        if own.max() > best:
            best, which, at = float(own.max()), nth, float(edges[int(own.argmax())])
        for k, shift in enumerate(shifts):
            chance[k] = max(chance[k], float(gains((rows + shift[rows]) % n).max()))
    high = float(np.quantile(chance, 0.9))
    return max(0.0, (best - high) / max(1 - high, 1e-3)), which, at


# ---- the host's clock ----


def _host(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    n = len(log.t)
    if n < FEWEST:
        return
    bad_before = np.r_[False, log.lossy[:-1]]
    late = np.full(n, np.nan)
    if np.isfinite(log.wake).any():
        late = np.where(np.isfinite(log.wake), log.wake, 0.0)
    step = np.diff(log.t, prepend=log.t[0])
    first = np.r_[True, log.run[1:] != log.run[:-1]]
    step[first] = log.period_s
    extra = step - log.period_s
    # A read that waits in vain takes its time; only what a good read left behind is the host's.
    gap = np.where(bad_before | first | (log.weight > 1), 0.0, extra)
    if np.isfinite(late).all():
        late = np.where(bad_before, 0.0, late)
        # Where the loop says how late it was, a gap that it does not own up to is a row that nobody kept.
        stalled = np.where(late > STALL_S, late, 0.0)
        if (late > STALL_S).sum() == 0 and float(np.max(late)) == 0.0:
            stalled = np.where(gap > STALL_S + 0.5 * log.period_s, gap, 0.0)
    else:
        jitter = float(np.quantile(np.abs(extra), 0.9))
        stalled = np.where(gap > max(STALL_S + 0.2 * log.period_s, 6 * jitter), gap, 0.0)
    # A read during which the host slept: everything comes, all at once and late.
    rtt = np.nanmax(np.where(np.isfinite(log.rtt), log.rtt, -1.0), axis=1)
    usual = float(np.median(rtt[rtt > 0])) if (rtt > 0).any() else np.nan
    if np.isfinite(usual):
        stalled = np.maximum(stalled, np.where((rtt > usual + STALL_S) & (rtt > 2 * usual + STALL_S), rtt - usual, 0.0))
    minutes = max(log.seconds / 60, 1e-3)
    total, longest, count = float(stalled.sum()), float(stalled.max()), int((stalled > 0).sum())
    a_minute = total / max(minutes, 0.5)
    often = 1 / (1 + (0.12 / max(a_minute, 1e-9)) ** 2) if count >= 3 else 0.0
    once = 1 / (1 + (0.25 / max(longest, 1e-9)) ** 4)
    words = (
        f"the host's loop stood still {count} times, {number(longest, 's')} at most, {number(a_minute, 's')} a minute"
    )
    yield "stall", Measure(max(often, once if count else 0.0), words), ()
    if episodes:
        hits = 0
        for one in episodes:
            low, high = max(0, one.start - 1), min(n, one.start + 2)
            own = stalled[low:high].copy()
            hits += bool((own > 0).any())
        share = hits / len(episodes)
        chance = min(1.0, 3 * count / n)
        value = max(0.0, (share - chance) / max(1 - chance, 1e-3))
        yield "host", Measure(value, f"{percent(share)} of the losses come when the host's loop stood still"), ()


# ---- round trips ----


def _waits(log: BusLog) -> tuple[Array, float, bool]:
    """(J,) s from one answer's end to the next one's, NaN where unknown; s that an answer takes on the wire; whether
    answers are handed over at the ticks of a timer, in whole ms of each other."""
    rtt, j = log.rtt, log.rtt.shape[1]
    known = np.isfinite(rtt)
    steps, whole = np.full(j, np.nan), []
    for k in range(1, j):
        both = known[:, k] & known[:, k - 1]
        if both.sum() >= FEWEST:
            between = rtt[both, k] - rtt[both, k - 1]
            low, high = np.quantile(between, [0.02, 0.98])
            steps[k] = float(np.clip(between, low, high).mean())
            whole.append(float((np.abs(between / TICK_S - np.round(between / TICK_S)) < 0.1).mean()))
    known_baud = log.baud[np.isfinite(log.baud) & (log.baud > 0)]
    wire = LONGEST_ANSWER * 10 / (float(np.median(known_baud)) if len(known_baud) else 1e6)
    return steps, wire, bool(whole) and float(np.median(whole)) > IN_TICKS


@dataclass(frozen=True)
class _Beat:
    """How first answers keep time.

    Attributes:
        wait_s: what they wait besides their time on the wire, median. period_s: of the beat that they keep best, 0 for none.
        strength: 0…1, of that.
    """

    wait_s: float
    period_s: float
    strength: float

    @property
    def share(self) -> float:
        """0…1, how much this is a timer: answers that wait for nothing keep any beat."""
        slow = 1 / (1 + (COMB_WAIT_S / max(self.wait_s, 1e-6)) ** 5)
        return slow * (0.3 + 0.7 / (1 + math.exp(-14 * (self.strength - 0.6))))


def _beat(log: BusLog) -> _Beat | None:
    """The beat of first answers; None where too few are known."""
    steps, wire, _ = _waits(log)
    if not np.isfinite(log.baud).any() and np.isfinite(steps).any():
        # Nobody said how fast the line is: its answers cannot follow each other faster than the wire lets them.
        wire = max(wire, float(np.nanmedian(steps)))
    first = np.nanmin(np.where(np.isfinite(log.rtt), log.rtt, np.inf), axis=1)
    good = np.isfinite(first) & (first < 0.3)
    if good.sum() < FEWEST:
        return None
    rows = np.flatnonzero(good)
    rtt = first[rows]
    # A request of 14 bytes and one for each servo, then the first answer: from there on it waits.
    wait = float(np.median(rtt)) - wire * (14 + len(log.joints) + LONGEST_ANSWER) / LONGEST_ANSWER
    stamps = log.t[rows] + rtt
    best, period = 0.0, 0.0
    for candidate in np.r_[16e-3, np.arange(4, 33) * 1e-3]:
        if wait < 0.3 * candidate:
            continue
        beats = []
        for values in (rtt, stamps):
            # The adapter's crystal is not ours: looked at in pieces.
            pieces = np.array_split(values, max(1, len(values) // 100))
            beats.append(float(np.mean([abs(np.exp(2j * np.pi * piece / candidate).mean()) for piece in pieces])))
        strength = max(beats)
        if strength > best + 0.05:
            best, period = strength, float(candidate)
    return _Beat(wait, period, best)


def _comb(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """Whether answers wait for the beat of a latency timer."""
    beat = _beat(log)
    if beat is None:
        return
    wait, best, value = beat.wait_s, beat.strength, beat.share
    told = [float(one["latency_timer_ms"]) for one in log.facts if "latency_timer_ms" in one]
    if told and min(told) >= 4 and wait > 0.25e-3 * min(told):
        value = max(value, 0.9)
    words = f"answers wait {number(max(wait, 0.0), 's')} besides their time on the wire"
    if best > 0.5:
        words += f", in a beat of {number(beat.period_s, 's')} (strength {number(best, decimals=2)})"
    if told:
        words += f"; the adapter's timer is said to be {number(min(told), 'ms')}"
    yield "comb", Measure(value, words), ()


def _least_waits(rtt: Array, wire: float, period_s: float) -> Array:
    """(J,) s that each servo waits at least before it answers, where a timer of this period hands answers over.

    An answer ends within the period before the tick that brings it. Reads begin at several phases of the timer, so that its
    end is known better than to a period: after the latest tick less a period, and before the earliest one; and not before
    the end of the answer before it. What USB adds now and then blurs that by some tenths of a ms, too much for single servos
    where the timer is long: then only the whole staircase counts.
    """
    j = rtt.shape[1]
    low, high = np.full(j, -np.inf), np.full(j, np.inf)
    for k in range(j):
        known = rtt[np.isfinite(rtt[:, k]), k]
        if len(known) >= FEWEST:
            # All but a few: a host that was late once must not say when an answer ended.
            earliest, latest = np.quantile(known, [0.02, 0.98])
            low[k], high[k] = min(earliest, latest - period_s), max(earliest, latest - period_s)
    seen = np.flatnonzero(np.isfinite(low))
    if len(seen) < 2:
        return np.zeros(j)
    first, last = seen[0], seen[-1]
    waits = np.full(j, max(0.0, (low[last] - high[first]) / (last - first) - wire))
    if period_s <= TICK_S:
        low, high = np.maximum.accumulate(low), np.minimum.accumulate(high[::-1])[::-1]
        waits[1:] = np.maximum(waits[1:], low[1:] - high[:-1] - wire)
    return waits


def _at_all_phases(rtt: Array, period_s: float) -> bool:
    """Whether reads begin at all phases of a timer alike."""
    first = rtt[np.isfinite(rtt[:, 0]), 0]
    count = np.histogram(first / period_s % 1.0, round(period_s / PHASE_S), (0.0, 1.0))[0]
    return bool(count.min() > EVEN * count.mean())


def _staircase(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """What each servo waits before it answers, from one answer's end to the next."""
    steps, wire, portions = _waits(log)
    if not np.isfinite(steps).any():
        return
    j, beat = len(steps), _beat(log)
    period = beat.period_s if beat is not None and beat.share > BEATS else TICK_S
    if portions and not _at_all_phases(log.rtt, period):
        # Whose answer just misses the tick comes a whole period later: that is no servo's waiting.
        excess = _least_waits(log.rtt, wire, period)
    else:
        # Asked at all phases of the timer, or handed over at once, what each took is the mean of its steps.
        excess = np.maximum(steps - wire, 0.0)
    worst, typical = float(np.nanmax(excess)), float(np.nanmedian(excess))
    joints = tuple(range(j)) if typical > 0.5 * worst else tuple(np.flatnonzero(np.nan_to_num(excess) > 0.5 * worst))
    value = 1 / (1 + (0.17e-3 / max(worst, 1e-9)) ** 4)
    said = [float(one["return_delay_s"]) for one in log.facts if "return_delay_s" in one]
    words = f"servos wait up to {number(worst, 's')} before they answer (median {number(typical, 's')})"
    if said:
        words += f"; the return delay is said to be {number(max(said), 's')}"
        if max(said) >= 0.2e-3:
            value = max(value, 0.9)
    yield "stairs", Measure(value, words), tuple(int(k) for k in joints)


def _gap(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """Whether reads are lost that follow a write too closely."""
    fresh = np.isfinite(log.cmd_t) & np.r_[True, np.diff(log.cmd_t) != 0]
    gap = log.t - log.cmd_t
    written = fresh & (gap >= -1e-4) & (gap < 0.05)
    if not episodes or written.sum() < FEWEST:
        return
    # "t" is when the request starts; a gap of many ms after each command is a loop that reads later.
    if float(np.median(gap[written])) > 0.02:
        return
    lossy = log.lossy
    in_written = float(lossy[written].mean())
    others = ~written
    in_others = float(lossy[others].mean()) if others.sum() >= FEWEST else math.nan
    values, edge = [0.0], math.nan
    spread = float(np.ptp(np.quantile(gap[written], [0.02, 0.98])))
    if spread > 0.02e-3:
        order = np.sort(gap[written])
        for q in np.linspace(0.03, 0.9, 30):
            cut = order[int(q * (len(order) - 1))]
            below, above = written & (gap <= cut), written & (gap > cut)
            if below.sum() < 3 or above.sum() < 3:
                continue
            low, high = float(lossy[below].mean()), float(lossy[above].mean())
            o = float(below.sum() / written.sum())
            c = float(lossy[below].sum() / max(1, lossy[written].sum()))
            gain = (c - o) / max(1 - o, 1e-6) * min(1.0, low / max(5 * high, 0.02))
            if cut < 3e-3 and gain > max(values):
                values.append(gain)
                edge = float(cut)
    by_gap = max(values)
    by_write = 0.0
    if math.isfinite(in_others) and in_written > 0:
        by_write = max(0.0, 1 - in_others / in_written) * min(1.0, in_written / 0.03) * 0.9
    value = max(by_gap, by_write)
    usual = float(np.median(gap[written]))
    if by_gap >= by_write and math.isfinite(edge):
        words = (
            f"reads within {number(edge, 's')} of a write are lost, later ones are not ({percent(by_gap)} explained)"
        )
    else:
        words = f"{percent(in_written)} of the reads {number(usual, 's')} behind a write are lost"
        words += f", {percent(in_others, decimals=1)} of the others" if math.isfinite(in_others) else ""
    if spread <= 0.02e-3 and not math.isfinite(in_others):
        return  # always the same gap, always a write: nothing to compare
    yield "gap", Measure(value, words), ()


def _baud(log: BusLog, episodes: Sequence[DropoutEpisode], reach: Reach) -> Look:
    """Whether broken answers grow with the rate of the line, over runs at several."""
    rates = np.unique(log.baud[np.isfinite(log.baud)])
    if len(rates) < 2:
        return
    crc = (log.word == WORDS.index("crc")) | (log.word == WORDS.index("short"))
    share = []
    for rate in rates:
        rows = np.isin(log.run, np.flatnonzero(log.baud == rate))
        share.append((float(crc[rows].sum()) + 0.5) / (float(log.asked[rows].sum()) + 1))
    growth = math.log(share[-1] / share[0]) / math.log(rates[-1] / rates[0])
    words = f"broken answers go from {percent(share[0], decimals=2)} at {int(rates[0])} baud to {percent(share[-1], decimals=2)} at {int(rates[-1])}"
    yield "baud", Measure(1 / (1 + math.exp(-3 * (growth - 0.4))), words), ()
