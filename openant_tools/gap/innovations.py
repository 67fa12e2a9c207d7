"""Commands that were lost, or acted now sooner and now later, one by one, in the innovations of what a fit leaves.

What acts at random times no simulation repeats, so that no fit shows it. But a servo whose command was lost follows the one before,
and by how much it is behind from then on its stiffness, damping and inertia say. What a fit leaves of positions is predicted from the
rows before it (an autoregression, whose innovations have no memory: Kay, Fundamentals of Statistical Signal Processing II, 1998), and
each command's answer is sought in what is new. Lost ones are taken out one after another while each is likelier than its price
(matching pursuit), and the same is asked of commands that had come twice as far, which no fault does: what a model does wrong looks
as much like these. Commands that scatter in time add a variance along all answers together, whose likelihood is exact; what a model does
wrong looks like a lateness, too, but like one that comes and goes with the motion, and that is taken out first (marginalised).

Nothing of it is fitted to what is judged: prices are the same for every recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from openant_tools.effects.effect import Chance, Effect
from openant_tools.gap.protocol import Played
from openant_tools.model.plant import Plant, Setup
from openant_tools.model.servo import read_damping, read_stiffness, read_velocity_gain
from openant_tools.recording.run import Run

__all__ = ["Irregular", "irregular"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: rows that predict the next one, and how many of them a joint's prediction is learned from at least
ORDER, LEAST_ROWS = 3, 60
#: deviations beyond which an innovation counts as so many: feet strike, torque comes
FARTHEST = 3.5
#: how often a deviation is taken anew of innovations that are cut so
TIMES = 20
#: commands that are lost in a row
BURSTS = (1, 2, 3, 5, 8, 12)
#: nats that a stretch of lost commands costs: one command in thirteen begins one, of any of these lengths
PRICE = float(np.log(12) + np.log(len(BURSTS)))
#: variances of when commands act, s², for one of what else is new, a deviation of which is 1
RATIOS = np.concatenate([[0.0], np.geomspace(0.0002, 0.08, 24) ** 2])
#: s for which what a model does wrong lasts, as a motion does; variances of such a lateness, as `RATIOS`; a share of it that is none
LASTS_S = 0.1
LASTING = np.concatenate([[0.0], np.geomspace(0.0005, 0.08, 8) ** 2])
NEGLIGIBLE = 1e-6
#: s by which a command is taken to be late where the direction of that is found
LATE_S = 0.004
#: rad/s between which a servo's natural frequency is believed
NATURAL_RAD_S = (3.0, 600.0)
#: numbers that only must not be zero
TINY = 1e-12
#: deviation of sizes, as a share: commands that hardly move a joint are not found, and servos do not answer as a second-order system does
KNOWN = 0.4
#: nats by which a log has to change where a command is lost, for it to count among those of which it could be told
TELLS = 2.0


@dataclass(frozen=True)
class Irregular:
    """What one hypothesis' innovations say of commands.

    Attributes:
        lost: (joints + 1,) nats by which lost commands of each joint, and of all joints at once, are likelier than none, but for the one
            stretch that says most.
        losses: (joints + 1,) commands that were found lost. told: of how many it could be told. longest_s: (joints + 1,) s in a row.
        scattered: (RATIOS,) nats by which commands that act at times that scatter are likelier than punctual ones. scatter_s: by how much.
        squares: (joints,) rad², of errors summed over rows. gone: (joints + 1, joints) those that lost commands of each joint, and of
            all joints at once, account for. moved: (joints,) rad²/s², those that commands a second off make, each by itself.
    """

    lost: Array
    losses: Array
    told: Array
    longest_s: Array
    scattered: Array
    scatter_s: Array
    squares: Array
    gone: Array
    moved: Array

    def explained(self, effect: Effect) -> Array:
        """(joints,) share of squared errors that it accounts for."""
        if effect.random is Chance.LOST:
            squares = self.gone[int(self.lost.argmax())]
        else:
            (std_s,), _ = self.sizes(effect)
            squares = std_s**2 * self.moved
        share: Array = np.clip(squares / np.maximum(self.squares, TINY), 0.0, 1.0)
        return share

    def nats(self, effect: Effect) -> float:
        """By how much it is likelier than on a healthy robot."""
        if effect.random is Chance.LOST:
            return float(self.lost.max())
        healthy = effect.quantities[0].small >= self.scatter_s
        return max(0.0, float(self.scattered.max() - self.scattered[healthy].max(initial=0.0)))

    def joints(self, effect: Effect) -> tuple[int, ...]:
        """Whose commands it befalls."""
        every, where = tuple(range(len(self.lost) - 1)), int(self.lost.argmax())
        return every if effect.random is Chance.SCATTERED or where == len(every) else (where,)

    def sizes(self, effect: Effect) -> tuple[Array, Array]:
        """Its coordinates, in the order of its quantities, and standard deviations."""
        if effect.random is Chance.SCATTERED:
            weight = np.exp(self.scattered - self.scattered.max())
            mean = float(weight @ self.scatter_s / weight.sum())
            return np.array([mean]), np.array([KNOWN * mean])
        where = int(self.lost.argmax())
        # Beside a few that nobody saw, of which an eighth are lost.
        count = self.told[where] + 4.0
        share = (self.losses[where] + 0.5) / count
        chance = np.sqrt(share * (1 - share) / count)
        longest = max(float(self.longest_s[where]), effect.quantities[1].small)
        return np.array([share, longest]), np.array([max(chance, KNOWN * share), 0.0])


@dataclass(frozen=True)
class _Answers:
    """One joint in one window.

    Attributes:
        new: (rows,) innovations, in deviations. to_offset, to_delay: (rows, commands), as these see a setpoint that is a radian off
            while a command is in force, and a command that comes a second after its time.
        times, values: (commands,) s, when they were sent, and rad.
        error: (rows,) rad. offset, delayed: (rows, commands) as to_offset and to_delay, as errors show it.
    """

    new: Array
    to_offset: Array
    to_delay: Array
    times: Array
    values: Array
    error: Array
    offset: Array
    delayed: Array

    @cached_property
    def spans(self) -> Ints:
        """(stretches, 2) from which command up to which ones may have been lost in a row."""
        n = len(self.values)
        every = [(first, first + burst) for burst in BURSTS for first in range(1, n - burst + 1)]
        return np.array(every, np.int64).reshape(-1, 2)

    @cached_property
    def lost(self) -> Array:
        """(rows, stretches) what innovations see where these were lost, and the command before them stays in force."""
        return self._without(self.to_offset, self.spans)

    def without(self, spans: Ints) -> Array:
        """(rows, stretches) the same, as errors show it."""
        return self._without(self.offset, spans)

    def _without(self, to_offset: Array, spans: Ints) -> Array:
        first, stop = spans.T
        up_to = np.pad(np.cumsum(to_offset, axis=1), ((0, 0), (1, 0)))
        at = np.pad(np.cumsum(to_offset * self.values, axis=1), ((0, 0), (1, 0)))
        out: Array = self.values[first - 1] * (up_to[:, stop] - up_to[:, first]) - (at[:, stop] - at[:, first])
        return out


def irregular(
    runs: Sequence[Played], errors: Sequence[Array], plants: Sequence[Plant], delays: Sequence[Array]
) -> Irregular:
    """What is left of some runs says of their commands.

    Args:
        errors: of each run (rows, joints) rad, measured minus simulated; NaN where nobody knows. plants: how each was simulated, as
            fitted. delays: of each, (joints,) s by which its commands act later than they are sent.
    """
    joints = len(runs[0].plant.joints)
    sums, largest = np.zeros((3, joints + 1)), np.zeros((2, joints + 1))
    squares, gone, moved = np.zeros(joints), np.zeros((joints + 1, joints)), np.zeros(joints)
    volume, left, rows = np.zeros((len(LASTING), len(RATIOS))), np.zeros((len(LASTING), len(RATIOS))), 0
    usual = {
        setup: _usual([error for one, error in zip(runs, errors, strict=True) if one.plant.setup is setup])
        for setup in Setup
    }
    for one, error, plant, delay in zip(runs, errors, plants, delays, strict=True):
        modes = _natural_modes(one.run, plant)
        for window in one.windows or [(float(one.run.t[0]), float(one.run.t[-1]) + 1.0)]:
            answers = {
                j: known
                for j in range(joints)
                if (known := _answers(
                    one, j, error[:, j], window, delay[j], modes[0][j], modes[1][j], usual[one.plant.setup][j]
                )) is not None
            }  # fmt: skip
            if not answers:
                continue
            every = list(answers.values())
            together = len({some.times.tobytes() for some in every}) == 1
            for j, some in answers.items():
                squares[j] += some.error @ some.error
                moved[j] += np.square(some.delayed).sum()
            groups = {j: [j] for j in answers} | ({joints: list(answers)} if together else {})
            for at, group in groups.items():
                said, most, less = _searched([answers[j] for j in group])
                sums[:, at], largest[:, at] = sums[:, at] + said, np.maximum(largest[:, at], most)
                gone[at, group] += less
            more, rest, count = _scattered(every if together else every[:1])
            volume, left, rows = volume + more, left + rest, rows + count
    # What else is new is as large as it is without what commands do.
    size = np.maximum(left, TINY) / max(rows, 1)
    likelihood = -0.5 * (rows * np.log(size / size[0, 0]) + volume)
    best, which = likelihood.argmax(axis=0), np.arange(len(RATIOS))
    scatter_s = np.sqrt(RATIOS * size[best, which])
    # A foot that slips once may look like a lost command in all joints, but not again and again.
    (lost, losses, told), (most, longest) = sums, largest
    return Irregular(lost - most, losses, told, longest, likelihood[best, which], scatter_s, squares, gone, moved)


def _usual(errors: Sequence[Array]) -> list[tuple[Array, float] | None]:
    """Of each joint how a row follows from those before it, newest first, and the deviation of what is new."""
    out: list[tuple[Array, float] | None] = []
    for j in range(errors[0].shape[1] if errors else 0):
        past, now = zip(*(_lagged(error[:, j]) for error in errors), strict=True)
        x, y = np.concatenate(past), np.concatenate(now)
        if len(y) < LEAST_ROWS:
            out.append(None)
            continue
        by = np.linalg.lstsq(x, y, rcond=None)[0]
        squares = np.square(y - x @ by)
        size = squares.mean()
        for _ in range(TIMES):
            size = np.minimum(squares, FARTHEST**2 * size).mean()
        out.append((by, max(float(np.sqrt(size)), TINY)))
    return out


def _lagged(values: Array) -> tuple[Array, Array]:
    """(rows, ORDER) of rows before, newest first, and (rows,), where all of them are known."""
    whole = sliding_window_view(values, ORDER + 1) if len(values) > ORDER else np.empty((0, ORDER + 1))
    whole = whole[np.isfinite(whole).all(axis=1)]
    return whole[:, -2::-1], whole[:, -1]


def _answers(
    one: Played, j: int, error: Array, window: tuple[float, float], delay: float, natural: float, damped: float,
    usual: tuple[Array, float] | None,
) -> _Answers | None:  # fmt: skip
    """A joint in a window; None where too little is known."""
    t = one.run.t
    rows = np.flatnonzero((t >= window[0]) & (t < window[1]))
    if usual is None or len(rows) <= ORDER:
        return None
    given = np.isfinite(commands := one.run.column(f"cmd.{one.plant.joints[j]}"))
    times, first = np.unique(one.run.command_times[given], return_index=True)
    # What came before a window began is in where it began.
    here = (np.append(times[1:], np.inf) > t[rows[0]]) & (times < t[rows[-1]])
    if here.sum() < 2:
        return None
    times, values = times[here], commands[given][first][here]
    acts = times + delay + one.plant.lead_s
    since = t[rows, None] - np.maximum(acts, t[rows[0]])
    until = t[rows, None] - np.append(acts[1:], np.inf)
    whole, ended, after = (
        _step_response(np.maximum(time, 0.0), natural, damped) for time in (since, until, since - LATE_S)
    )
    to_offset = whole - ended
    to_delay = (after - whole) / LATE_S * np.diff(values, prepend=values[0])
    by, size = usual
    lags = sliding_window_view(error[rows], ORDER + 1)
    known = np.isfinite(lags).all(axis=1)
    if not known.any():
        return None
    ahead = np.concatenate([-by[::-1], [1.0]]) / size
    # The autoregression reaches back where a row's answer was none yet: that is 0, not unknown.
    new = np.clip(lags[known] @ ahead, -FARTHEST, FARTHEST)
    seen = [
        np.einsum("kcl,l->kc", sliding_window_view(x, ORDER + 1, axis=0)[known], ahead) for x in (to_offset, to_delay)
    ]
    now = rows[ORDER:][known]
    return _Answers(new, seen[0], seen[1], times, values, error[now], to_offset[ORDER:][known], to_delay[ORDER:][known])


def _searched(group: Sequence[_Answers]) -> tuple[Array, Array, Array]:
    """Of joints whose commands are lost at once: nats, of how many that were found, of how many it could be told; nats of the stretch
    that says most, and s of the longest; of each joint rad² of errors that they account for."""
    one, new, seen = (
        group[0],
        np.concatenate([some.new for some in group]),
        np.concatenate([some.lost for some in group]),
    )
    half = 0.5 * np.square(seen).sum(axis=0)
    gains, found = _pursued(one.spans, seen, half, new)
    mirrored = _pursued(one.spans, seen, half, -new)[0]
    gone, longest = np.zeros(len(one.times), bool), 0.0
    for first, stop in found:
        gone[first:stop] = True
        longest = max(longest, float(one.times[min(stop, len(gone) - 1)] - one.times[first]))
    # The first stretches are of one command each.
    tells = half[: len(gone) - 1] > TELLS
    nats = sum(gains) - sum(mirrored)
    less = np.zeros(len(group))
    if found:
        shown = [some.without(np.array(found)).sum(axis=1) for some in group]
        less = np.array([(2 * some.error - shows) @ shows for some, shows in zip(group, shown, strict=True)])
    return (
        np.array([nats, (tells & gone[1:]).sum(), tells.sum()]),
        np.array([max(gains, default=0.0), longest]),
        less,
    )


def _pursued(spans: Ints, seen: Array, half: Array, new: Array) -> tuple[list[float], list[Ints]]:
    """nats of each stretch that is found among what is new, and which commands that is; of −new, those that had gone twice as far.

    Args:
        spans, seen: as of `_Answers`, of some joints one after another. half: (stretches,) of the squares of what they show.
    """
    gains, found = list[float](), list[Ints]()
    along, free = seen.T @ new, np.ones(len(spans), bool)
    while (more := np.where(free, along - half - PRICE, 0.0)).max(initial=0.0) > 0:
        best = int(more.argmax())
        gains.append(float(more[best]))
        found.append(spans[best])
        along = along - seen.T @ seen[:, best]
        free &= (spans[:, 0] >= spans[best, 1]) | (spans[:, 1] <= spans[best, 0])
    return gains, found


def _scattered(group: Sequence[_Answers]) -> tuple[Array, Array, int]:
    """Of commands that scatter, one packet for all joints: (LASTING, RATIOS) logarithm of the volume that they add, and squares left; rows.

    Beside a lateness that comes and goes with the motion, as what a model does wrong looks.
    """
    normal = np.sum([some.to_delay.T @ some.to_delay for some in group], axis=0)
    cross = np.sum([some.to_delay.T @ some.new for some in group], axis=0)
    new = np.concatenate([some.new for some in group])
    apart = np.subtract.outer(group[0].times, group[0].times) / LASTS_S
    spread, modes = np.linalg.eigh(np.exp(-0.5 * np.square(apart)))
    slow = modes[:, spread > NEGLIGIBLE] * np.sqrt(spread[spread > NEGLIGIBLE])
    shows, turn = np.linalg.eigh(slow.T @ normal @ slow)
    slow = slow @ turn
    seen, along = normal @ slow, slow.T @ cross
    volume, left = np.zeros((len(LASTING), len(RATIOS))), np.zeros((len(LASTING), len(RATIOS)))
    for n, ratio in enumerate(LASTING):
        # By Woodbury, what is seen of each command beside that lateness.
        taken = ratio / (1 + ratio * np.maximum(shows, 0.0))
        eigen, ways = np.linalg.eigh(normal - (seen * taken) @ seen.T)
        grows = 1 + RATIOS[:, None] * np.maximum(eigen, 0.0)
        more = RATIOS[:, None] / grows * np.square(ways.T @ (cross - seen @ (taken * along)))
        volume[n] = np.log1p(ratio * np.maximum(shows, 0.0)).sum() + np.log(grows).sum(axis=1)
        left[n] = new @ new - taken @ np.square(along) - more.sum(axis=1)
    return volume, left, len(new)


def _natural_modes(run: Run, plant: Plant) -> tuple[Array, Array]:
    """(joints,) natural frequencies, rad/s, and damping ratios of a model's servos where a run begins."""
    model, data = plant.model, mujoco.MjData(plant.model)
    data.qpos[plant.qpos] = np.nan_to_num(run.signal("pos", plant.joints)[0])
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    own = np.maximum(inertia[plant.dof, plant.dof], 1e-9)
    joints = range(len(plant.joints))
    stiffness = np.array([max(read_stiffness(model, plant, j), 1e-9) for j in joints])
    damping = np.array([read_damping(model, plant, j) + read_velocity_gain(model, plant, j) for j in joints])
    return np.clip(np.sqrt(stiffness / own), *NATURAL_RAD_S), damping / (2 * np.sqrt(stiffness * own))


def _step_response(t: Array, natural: float, damped: float) -> Array:
    """Of a second-order system, the share of a step that it has gone t after it."""
    root = np.sqrt(complex(damped**2 - 1))
    if abs(root) < 1e-3:
        root = complex(1e-3)
    slow, fast = natural * (damped - root), natural * (damped + root)
    out: Array = np.real(1 - (fast * np.exp(-slow * t) - slow * np.exp(-fast * t)) / (fast - slow))
    return out
