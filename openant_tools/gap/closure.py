"""How far the gap closes on runs that were not used: the model re-fitted within tolerance, with causes and without."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.effect import Effect
from openant_tools.gap.fitting import Fits
from openant_tools.gap.hypothesis import Refit
from openant_tools.gap.innovations import Irregular, irregular
from openant_tools.gap.nuisance import BODY, HEAT_LOSS, LESS, UNWRITTEN
from openant_tools.gap.prediction import Predictions
from openant_tools.model.gap import share_closed
from openant_tools.numbers import stored

__all__ = ["Closure", "calibration_of", "closures", "heat_loss_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Closure:
    """What a hypothesis leaves of the gap on folds that its fit had not seen.

    Attributes:
        before, after, floor: rad, of joints. closed: share of the excess that is gone; low, high: over the folds, 95 %.
        joints: how many channels are positions, the first ones.
        squares: (folds, channels) summed over rows, of errors in deviations that sensors and feet that chatter give them; counts: (folds,
            channels) of how many.
        apart: (folds, channels) squares of how far it is from what it is compared with, summed over the same rows.
        likelihood, within, std: as of `Fit`.
        refit: on all training runs together. irregular: what it leaves says of commands.
    """

    before: float
    after: float
    floor: float
    closed: float
    low: float
    high: float
    likelihood: float
    within: float
    joints: int
    squares: Array
    apart: Array
    counts: Array
    refit: Refit
    std: tuple[Mapping[str, float], ...]
    irregular: Irregular

    def support(self, other: Closure) -> float:
        """Logarithm of how much less it leaves than another on the same folds, rms, mean of them, summed over joints and body sensors.

        Up to a factor that of their likelihoods, where errors of each channel on each fold have a size of their own that nobody knows,
        but not less than they are known to.
        """
        return self._less(other.squares, self.squares)

    @property
    def foretold(self) -> float:
        """What support would be if it were right: what it leaves is none of what it says that the other leaves beside that."""
        return self._less(self.squares + self.apart, self.squares)

    def explained(self, effect: Effect) -> float:
        """What support a cause of random times would have: of errors of joints it leaves what its commands do not account for."""
        left = np.ones(self.squares.shape[1])
        left[: self.joints] -= self.irregular.explained(effect)
        return self._less(self.squares, left * self.squares)

    @property
    def uneven(self) -> float:
        """Logarithm of how many times its sensors' errors the joint that it leaves worst keeps on held-out folds, rms, mean of them, less that
        of the median joint."""
        squares, counts = self.squares[:, : self.joints], self.counts[:, : self.joints]
        each = 0.5 * np.log1p(squares / np.maximum(counts, 1.0))
        joints = each.sum(axis=0) / np.maximum((counts > 0).sum(axis=0), 1)
        return float(joints.max() - np.median(joints))

    def likelier(self, other: Closure) -> float:
        """nats by which what it was fitted to is likelier than by another."""
        return self.likelihood - other.likelihood

    def _less(self, before: Array, after: Array) -> float:
        rows = np.maximum(self.counts, 1.0)  # of a fold without any nothing is left
        each = np.log((before / rows + 1) / (after / rows + 1))
        return float(0.5 * each.sum()) / len(rows)


def closures(
    fits: Fits, starts: Sequence[Refit], folds: Sequence[Collection[int]], training: Sequence[int]
) -> list[Closure]:
    """What each hypothesis leaves of the gap.

    Args:
        starts: the first is what the others are compared with.
        folds: runs judged together by fits that have not seen them. training: the runs to fit on, but for those of the fold.
    """
    predictions, found = fits.predictions, fits.refit(starts, training, folds)
    channels = len(predictions.sigma)
    each, counts = np.zeros((len(starts), len(folds), channels)), np.zeros((len(folds), channels))
    apart = np.zeros_like(each)
    gaps, known = np.zeros((len(starts) + 1, len(folds))), np.zeros(len(folds))
    left: list[dict[int, Array]] = [{} for _ in starts]
    for f, fold in enumerate(folds):
        held_out = [one.folds[f] for one in found]
        for k in sorted(fold):
            errors = predictions.over_windows(k, held_out)
            for mine, of_one in zip(left, errors, strict=True):
                mine.setdefault(k, of_one[:, : predictions.joints])
            deviations = errors / fits.solver.deviation(k, found[0].whole)
            squares, good = _squares(deviations)
            each[:, f], counts[f] = each[:, f] + squares, counts[f] + good
            apart[:, f] += _squares(deviations - deviations[0])[0]
            squares, good = _squares(np.concatenate([predictions.before(k)[None], predictions.errors(k, held_out)]))
            gaps[:, f] += squares.sum(axis=1)
            known[f] += good.sum()
    floor = float(np.sqrt(np.mean(predictions.floor**2)))
    out = []
    for n, one in enumerate(found):
        both = gaps[[0, n + 1]]
        before, after = (float(left) for left in np.sqrt(both.sum(axis=1) / known.sum()))
        low, high = _interval(both[0], both[1], known, floor)
        out.append(
            Closure(
                before, after, floor, _closed(before, after, floor), low, high, one.likelihood, one.within, predictions.joints,
                each[n], apart[n], counts, one.whole, one.std, _irregular(predictions, one.whole, left[n]),
            )
        )  # fmt: skip
    return out


def _irregular(predictions: Predictions, refit: Refit, left: Mapping[int, Array]) -> Irregular:
    """What errors of held-out runs say of when their commands came."""
    runs = [predictions.protocol.runs[k] for k in left]
    robots = [predictions.robot(refit, k) for k in left]
    plants = [
        dataclasses.replace(one.plant, model=robot.model(one.plant)) for one, robot in zip(runs, robots, strict=True)
    ]
    return irregular(runs, list(left.values()), plants, [robot.delay for robot in robots])


def _squares(errors: Array) -> tuple[Array, Array]:
    """(robots, channels) summed over rows that all robots have, and (channels,) of how many."""
    good = np.isfinite(errors).all(axis=0)
    return np.square(np.where(good, errors, 0.0)).sum(axis=1), good.sum(axis=0).astype(np.float64)


def _closed(before: float, after: float, floor: float) -> float:
    share = share_closed(before, after, floor)
    return share if np.isfinite(share) else 0.0


def _interval(before: Array, after: Array, counts: Array, floor: float) -> tuple[float, float]:
    """95 % of the closure over folds drawn with replacement."""
    rng = np.random.default_rng(0)
    draws = rng.integers(len(counts), size=(400, len(counts)))
    values = []
    for draw in draws:
        total = counts[draw].sum()
        values.append(
            _closed(float(np.sqrt(before[draw].sum() / total)), float(np.sqrt(after[draw].sum() / total)), floor)
        )
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def calibration_of(predictions: Predictions, refit: Refit, judged: Sequence[int]) -> dict[str, dict[str, float]]:
    """What moved within tolerance: kind → joint or `BODY` → factor, or what is added (N·m, rad, s, kg), see `adjust`.

    Args:
        judged: runs on which servos were as warm as those of the model are to be.
    """
    out: dict[str, dict[str, float]] = {}
    joints = predictions.protocol.joints
    for one, u in zip(predictions.names, refit.nuisance, strict=True):
        value = one.value(float(u))
        if one.of_imu or one.name in UNWRITTEN:
            continue
        if one.name == HEAT_LOSS:
            for kind in LESS:
                for joint, left in zip(joints, 1 / (1 + value * predictions.warmth(judged)), strict=True):
                    if kind in out:
                        out[kind][joint] *= float(left)
            continue
        for name in [joints[j] for j in one.joints] or [BODY]:
            out.setdefault(one.name, {})[name] = value
    return {kind: {name: stored(value) for name, value in values.items()} for kind, values in out.items()}


def heat_loss_of(predictions: Predictions, refit: Refit) -> float | None:
    """1/°C of torque that warm servos lose; None where none was warmer in one run than in another."""
    return next(
        (
            one.value(float(u))
            for one, u in zip(predictions.names, refit.nuisance, strict=True)
            if one.name == HEAT_LOSS
        ),
        None,
    )
