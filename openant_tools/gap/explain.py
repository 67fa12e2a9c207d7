"""How large a cause would have to be, and where it would sit, to explain a log: fits of hypotheses on simulated robots.

A hypothesis is a set of causes at places. Its sizes are fitted so that the robot simulated with them differs from the model as
the real one does, in the measure in which healthy robots of one build are all alike: what tolerances do costs little there, so
that they need not be fitted besides. All hypotheses are simulated side by side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.cause import Cause, Quantity, catalogue
from openant_tools.gap.features import Floats, differences
from openant_tools.gap.judge import Whitening
from openant_tools.gap.protocol import Played, Protocol
from openant_tools.gap.robot import Robot
from openant_tools.gap.simulation import simulate
from openant_tools.model.rollout import Rollouts

__all__ = ["Explained", "Hypothesis", "Part", "Scene", "fit"]

Array = NDArray[np.float64]
Tell = Callable[[float, str], None]

#: strengths from which a size is sought, and how a shape that is not fitted stands
STARTS = (0.1, 0.45, 0.85)
#: iterations of Gauss and Newton, and the least improvement (share) that goes on
ITERATIONS, ENOUGH = 3, 5e-3
#: share of a size by which it is varied, and the least variation in units of `small`
STEP, LEAST_STEP = 0.08, 0.25
#: how far beyond `large` a size may go
BEYOND = 2.5


@dataclass(frozen=True)
class Part:
    """One cause at one place."""

    cause: str
    joints: tuple[int, ...]

    @property
    def definition(self) -> Cause:
        return catalogue()[self.cause]


#: causes at places
Hypothesis = tuple[Part, ...]


@dataclass(frozen=True)
class Explained:
    """A hypothesis fitted.

    Attributes:
        x: of each part, its coordinates; std: their standard deviations, from curvature alone.
        misfit: mean square of the whitened difference that is left; before: with no cause at all.
    """

    hypothesis: Hypothesis
    x: tuple[Mapping[str, float], ...]
    std: tuple[Mapping[str, float], ...]
    misfit: float
    before: float

    @property
    def gain(self) -> float:
        """Share of the misfit that the hypothesis takes away."""
        return 1 - self.misfit / self.before if self.before > 0 else 0.0


@dataclass
class Scene:
    """The runs on which hypotheses are compared, and the measure.

    Attributes:
        protocol: for sizes and scopes. runs: those simulated. whitening: of their features, one after another.
        seen: (features,) of the robot at hand.
    """

    protocol: Protocol
    runs: Sequence[Played]
    whitening: Whitening
    columns: NDArray[np.bool_]
    seen: Floats

    def __post_init__(self) -> None:
        self._rollouts = [Rollouts(one.plant, [one.run]) for one in self.runs]
        self._nominal = dataclasses.replace(self.protocol, runs=tuple(self.runs)).nominal()
        self._target = self.whitening(self.seen[None, self.columns])[0]
        self.before = float(
            np.mean((self._target - self.whitening(np.zeros_like(self.seen)[None, self.columns])[0]) ** 2)
        )

    def robot(self, hypothesis: Hypothesis, x: Sequence[Mapping[str, float]]) -> Robot:
        """The model with causes of these sizes."""
        return self.robot_of(self.protocol, hypothesis, x)

    @staticmethod
    def robot_of(protocol: Protocol, hypothesis: Hypothesis, x: Sequence[Mapping[str, float]]) -> Robot:
        """The same, for a protocol."""
        reference = protocol.reference
        robot = Robot(len(protocol.joints), reference.low, reference.high)
        for part, coordinates in zip(hypothesis, x, strict=True):
            joints = np.array(part.joints)
            cause = part.definition
            cause.enter(robot, joints, cause.values(coordinates, reference, joints))
        return robot

    def residuals(self, robots: Sequence[Robot]) -> Floats:
        """(robots, features) whitened differences between the robot at hand and these."""
        parts = []
        for one, rollouts, nominal in zip(self.runs, self._rollouts, self._nominal, strict=True):
            found = simulate(rollouts, robots, signals=one.signals).signals
            parts.append(one.layout.features(differences(found, nominal, one.signals)))
        x = np.concatenate(parts, axis=1)[:, self.columns]
        out: Floats = np.nan_to_num(self.whitening(x) - self._target)
        return out


@dataclass
class _Search:
    """One hypothesis on its way: free coordinates in order."""

    hypothesis: Hypothesis
    fixed: list[dict[str, float]]
    free: list[tuple[int, Quantity]]
    u: Array
    cost: float = np.inf
    residual: Floats | None = None
    done: bool = False
    covariance: Array | None = None

    def point(self, u: Array) -> list[dict[str, float]]:
        out = [dict(one) for one in self.fixed]
        for (part, q), value in zip(self.free, u, strict=True):
            out[part][q.name] = float(value)
        return out


def fit(
    scene: Scene, hypotheses: Sequence[Hypothesis], known: Mapping[Part, Mapping[str, float]] | None = None
) -> list[Explained]:
    """Fit hypotheses, all of them side by side.

    Args:
        known: sizes found before, from which parts start; the others are sought from several strengths and signs.
    """
    known = known or {}
    searches: list[list[_Search]] = []
    for hypothesis in hypotheses:
        searches.append([_begin(hypothesis, start, known) for start in _starts(hypothesis, known)])
    _evaluate(scene, [search for group in searches for search in group])
    best = [min(group, key=lambda search: search.cost) for group in searches]
    damping = np.full(len(best), 1e-3)
    for _ in range(ITERATIONS):
        going = [k for k, search in enumerate(best) if not search.done]
        if not going:
            break
        tangents = _tangents(scene, [best[k] for k in going])
        tries = []
        for k, tangent in zip(going, tangents, strict=True):
            search = best[k]
            assert search.residual is not None
            normal, gradient = tangent @ tangent.T, tangent @ search.residual
            search.covariance = np.linalg.pinv(normal)
            low, high = _bounds(search)
            moved = []
            for scale in (1.0, 30.0):
                step = np.linalg.solve(
                    normal + damping[k] * scale * np.diag(np.diag(normal) + 1e-9), -gradient.astype(np.float64)
                )
                moved.append(_Search(search.hypothesis, search.fixed, search.free, np.clip(search.u + step, low, high)))
            tries.append(moved)
        _evaluate(scene, [one for moved in tries for one in moved])
        for k, moved in zip(going, tries, strict=True):
            found = min(moved, key=lambda one: one.cost)
            search = best[k]
            if found.cost < search.cost:
                found.covariance = search.covariance
                found.done = (search.cost - found.cost) < ENOUGH * search.cost
                best[k] = found
                damping[k] = max(damping[k] / 5, 1e-6)
            else:
                damping[k] *= 20
                search.done = damping[k] > 10
    return [_explained(scene, search) for search in best]


def _starts(hypothesis: Hypothesis, known: Mapping[Part, Mapping[str, float]]) -> list[list[dict[str, float]]]:
    """Coordinates from which to begin: of the parts that nothing is known of, in all combinations of strength and sign."""
    options: list[list[dict[str, float]]] = [[]]
    unknown = sum(part not in known for part in hypothesis)
    for part in hypothesis:
        if part in known:
            options = [[*one, dict(known[part])] for one in options]
            continue
        strengths = STARTS if unknown == 1 else STARTS[1:2]
        mine = [x for strength in strengths for x in part.definition.starts(strength)]
        options = [[*one, x] for one in options for x in mine]
    return options


def _begin(hypothesis: Hypothesis, start: list[dict[str, float]], known: Mapping[Part, Mapping[str, float]]) -> _Search:
    free = [(k, q) for k, part in enumerate(hypothesis) for q in part.definition.quantities]
    return _Search(hypothesis, start, free, np.array([start[k][q.name] for k, q in free]))


def _bounds(search: _Search) -> tuple[Array, Array]:
    low, high = [], []
    for _, q in search.free:
        if q.shape:
            low.append(q.small / 2)
            high.append(q.large * 2)
        else:
            high.append(q.large * BEYOND)
            low.append(-q.large * BEYOND if q.signed else 0.0)
    limits = np.array(high)
    # A share cannot be more than all.
    for k, (part, q) in enumerate(search.free):
        if q.unit == "1" and not q.signed and not q.shape and search.hypothesis[part].cause not in ("payload",):
            limits[k] = min(limits[k], 0.98)
    return np.array(low), limits


def _evaluate(scene: Scene, searches: Sequence[_Search]) -> None:
    robots = [scene.robot(search.hypothesis, search.point(search.u)) for search in searches]
    residuals = scene.residuals(robots)
    for search, residual in zip(searches, residuals, strict=True):
        search.residual, search.cost = residual, float(np.mean(np.square(residual)))


def _tangents(scene: Scene, searches: Sequence[_Search]) -> list[Floats]:
    """Of each search (free, features): how the residual moves with each coordinate."""
    robots, steps = [], []
    for search in searches:
        _low, high = _bounds(search)
        for k, (_, q) in enumerate(search.free):
            step = STEP * abs(search.u[k]) if q.shape else max(STEP * abs(search.u[k]), LEAST_STEP * q.small)
            if search.u[k] + step > high[k]:
                step = -step
            u = search.u.copy()
            u[k] += step
            robots.append(scene.robot(search.hypothesis, search.point(u)))
            steps.append(step)
    residuals = scene.residuals(robots)
    out, at = [], 0
    for search in searches:
        n = len(search.free)
        assert search.residual is not None
        rows = (residuals[at : at + n] - search.residual) / np.array(steps[at : at + n], np.float32)[:, None]
        out.append(rows)
        at += n
    return out


def _explained(scene: Scene, search: _Search) -> Explained:
    x = search.point(search.u)
    spread: list[dict[str, float]] = [{} for _ in search.hypothesis]
    for k, (part, q) in enumerate(search.free):
        variance = 0.0 if search.covariance is None else float(search.covariance[k, k]) * max(search.cost, 1.0)
        spread[part][q.name] = float(np.sqrt(max(variance, 0.0)))
    return Explained(search.hypothesis, tuple(x), tuple(spread), search.cost, scene.before)
