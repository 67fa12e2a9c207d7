"""Descents to where hypotheses leave least, by what each run says of it joint by joint (Levenberg–Marquardt, slopes by Broyden 1965)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.features import Floats
from openant_tools.gap.hypothesis import Refit, bounds_of, prior_of, quantities, sizes

__all__ = ["END", "LEAST_GAIN", "Block", "Descent"]

Array = NDArray[np.float64]

#: standard deviation of a prior, as a share of the tolerance; and where it ends: a re-fit within tolerance is no effect
SPREAD, END = 0.6, 1.0
#: the step, in those by which slopes are learnt, and the gain, in nats, below which slopes lead no farther: feet that chatter make as much
SETTLED, LEAST_GAIN = 0.03, 2.0
#: times all that is known of each coordinate by which a step is held back that made things worse, by so much more each time; and at most
HELD_BACK, MOST = 4.0, 64.0
#: by how much each is varied to learn its slope, in tolerances; as a share of a size, of the least that matters where there is none, and of a
#: shape's range
NEARBY, NEARBY_SIZE, NEARBY_NONE, NEARBY_SHAPE = 0.3, 0.15, 0.5, 0.1


@dataclass(frozen=True)
class Block:
    """What a run says where a descent is, channel by channel; errors count in deviations of their sensors.

    Attributes:
        cost: (channels,) squares. more: (channels, coordinates, coordinates), slope: (channels, coordinates), so that so far from there
            squares are cost + 2 slope·moved + moved·more·moved. count: (channels,) of how many independent errors.
    """

    cost: Array
    more: Array
    slope: Array
    count: Array

    @classmethod
    def of(cls, errors: Floats, slopes: Floats, count: Array) -> Block:
        """Of weighted errors (rows, channels) and how each coordinate moves them (coordinates, rows, channels)."""
        along = slopes.transpose(2, 0, 1)  # in float32: nothing of a fit is larger
        left = errors.T[:, :, None]
        return cls(
            np.square(errors, dtype=np.float64).sum(axis=0),
            (along @ along.transpose(0, 2, 1)).astype(np.float64),
            (along @ left)[:, :, 0].astype(np.float64),
            np.maximum(count, 1.0),
        )

    def left(self, moved: Array) -> Array:
        """(channels,) squares that are foretold so far from there."""
        out: Array = np.maximum(self.cost + 2 * self.slope @ moved + self.more @ moved @ moved, 0.0)
        return out

    def inflation(self, left: Array) -> Array:
        """(channels,) how many times its sensors' variance."""
        out: Array = np.maximum(left / self.count, 1.0)
        return out

    @property
    def surprise(self) -> float:
        """Minus twice the logarithm of how likely it is, with errors as large as they are, if not smaller than sensors'."""
        inflation = self.inflation(self.cost)
        return float((self.cost / inflation + self.count * np.log(inflation)).sum())

    def weighted(self, weight: Array) -> tuple[Array, Array]:
        """Normal matrix and gradient of all channels together."""
        return np.tensordot(weight, self.more, 1), weight @ self.slope


@dataclass
class Descent:
    """One hypothesis on its way to where it leaves least.

    Attributes:
        u: where it looks next, sizes of causes, then tolerances. prior, scale: around what, and how far it may go. low, high: between
            which it stays.
        at, least, errors: where it was best, what it cost there, and of each run the weighted errors (rows, channels).
        slopes: of each run, weighted, (coordinates, rows, channels); blocks: what each run says where it was best.
        bends: which of them are other ones wherever it comes to. damping: how much steps are held back.
        gained: nats, by its last step that gained.
    """

    start: Refit
    causes: int
    u: Array
    prior: Array
    scale: Array
    low: Array
    high: Array
    steps: Array
    slopes: dict[int, Floats]
    at: Array
    bends: NDArray[np.bool_]
    least: float = np.inf
    damping: float = 0.0
    gained: float = np.inf
    errors: dict[int, Floats] = dataclasses.field(default_factory=dict)
    blocks: dict[int, Block] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, start: Refit, tolerances: int, learnt: Mapping[int, Floats]) -> Descent:
        """From a start, with what slopes are known of the tolerances alone."""
        at = sizes(start)
        centre, deviations = prior_of(start)
        low, high = np.array([*map(bounds_of, quantities(start)), *[(-END, END)] * tolerances]).T
        least = [NEARBY_SHAPE if q.share else 0.0 if q.shape else NEARBY_NONE * q.small for q in quantities(start)]
        steps = np.maximum(NEARBY_SIZE * np.abs(at), least)
        u: Array = np.concatenate([at, start.nuisance])
        slopes = {
            k: np.concatenate([np.zeros((len(at), *known.shape[1:]), np.float32), known]) for k, known in learnt.items()
        }
        return cls(
            start,
            len(at),
            u,
            np.concatenate([centre, np.zeros(tolerances)]),
            np.concatenate([deviations, np.full(tolerances, SPREAD)]),
            low,
            high,
            np.concatenate([steps, np.ones(tolerances)]),
            slopes,
            u,
            np.array([True] * len(at) + [False] * tolerances),
        )

    @property
    def inside(self) -> bool:
        """Whether it is best between its bounds."""
        return bool(((self.at >= self.low) & (self.at <= self.high)).all())

    def of_one_build(self) -> Descent:
        """From where it is best, with no more of its last cause than robots of one build differ by."""
        own = len(self.start.hypothesis[-1].definition.quantities)
        most = np.full(len(self.u), np.inf)
        most[self.causes - own : self.causes] = [np.inf if q.shape else q.small for q in quantities(self.start)[-own:]]
        return dataclasses.replace(
            self, low=np.maximum(self.low, -most), high=np.minimum(self.high, most), damping=0.0, gained=np.inf,
            slopes=dict(self.slopes),
        )  # fmt: skip

    def of_this_size(self) -> Descent:
        """With its causes as large as they are."""
        still = np.arange(len(self.u)) < self.causes
        return dataclasses.replace(
            self, low=np.where(still, self.u, self.low), high=np.where(still, self.u, self.high), bends=self.bends & ~still,
        )  # fmt: skip

    def begin(self) -> None:
        """Once more, from where it was best, with slopes that are looked at there."""
        self.u, self.damping, self.least, self.slopes, self.errors = self.at, 0.0, np.inf, {}, {}

    @property
    def goes_on(self) -> bool:
        """Whether there is a step to try."""
        return (
            self.damping <= MOST
            and self.gained > LEAST_GAIN
            and bool((np.abs(self.u - self.at) > SETTLED * self.steps).any())
        )

    @property
    def nearby(self) -> Array:
        """(coordinates,) by how much each is varied to learn its slope."""
        return np.concatenate([self.steps[: self.causes], NEARBY * self.steps[self.causes :]])

    def moved(self, members: Iterable[tuple[int, NDArray[np.bool_]]]) -> Array:
        """Where it looks next, with some coordinates a step farther."""
        out = self.u.copy()
        for p, _ in members:
            out[p] += self.nearby[p]
        return out

    def spread(self, moved: Array) -> list[Array]:
        """The same with all tolerances so many steps farther, of each robot: (robots, tolerances)."""
        causes = np.zeros((len(moved), self.causes))
        return list(self.u + np.concatenate([causes, moved], axis=1) * self.nearby)

    def told(self, found: Mapping[int, Floats], counts: Mapping[int, Array]) -> None:
        """What each run showed where it looked: weighted errors, and of how many independent ones they are."""
        step = (self.u - self.at) / self.scale
        for k, now in found.items():
            if k in self.errors and step.any():
                # Slopes follow what the step showed (Broyden 1965); steps count in priors.
                missed = now - self.errors[k] - np.tensordot((step * self.scale).astype(np.float32), self.slopes[k], 1)
                along = (step / (step @ step) / self.scale).astype(np.float32)
                self.slopes[k] = self.slopes[k] + along[:, None, None] * missed
        seen = {k: Block.of(now, self.slopes[k], counts[k]) for k, now in found.items()}
        cost = float(np.sum(np.square((self.u - self.prior) / self.scale)))
        cost += sum(block.surprise for block in seen.values())
        if cost <= self.least:
            self.gained = (self.least - cost) / 2
            self.at, self.least, self.errors, self.blocks = self.u, cost, dict(found), seen
            self.damping = self.damping / HELD_BACK if self.damping > 1 else 0.0
        else:
            self.blocks = {k: Block.of(best, self.slopes[k], counts[k]) for k, best in self.errors.items()}
            self.damping = max(self.damping, 1.0) * HELD_BACK
