"""How large a cause would have to be to explain a log: fits on simulated robots.

Its size is fitted so that the robot simulated with it differs from the model as the real one does, in the measure in which
healthy robots of one build are all alike: what tolerances do costs little there, so that they need not be fitted besides. All
causes are simulated side by side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.effect import Cause, Quantity
from openant_tools.effects.robot import Reference, Robot
from openant_tools.gap.features import Floats
from openant_tools.gap.judge import Judgement
from openant_tools.gap.protocol import Played, Players, Protocol
from openant_tools.gap.thresholds import HEAT
from openant_tools.gap.whitening import Metric
from openant_tools.model.plant import Setup

__all__ = [
    "Explained",
    "Hypothesis",
    "Part",
    "Scene",
    "bounds_of",
    "explain",
    "fit",
    "known_to",
    "robot_with",
    "scene_of",
]

Array = NDArray[np.float64]

#: iterations of Gauss and Newton, and the least improvement (share) that goes on
ITERATIONS, ENOUGH = 2, 0.015
#: of Levenberg and Marquardt: at the beginning, and above which a shorter step is tried beside each
DAMPING, CAUTIOUS = 1e-3, 1e-3
#: share of a size by which it is varied, and the least variation in units of `small`; where feet touch the floor less says how
#: contacts chatter, not what the size does
STEP, LEAST_STEP = 0.08, 0.25
FLOOR_STEP, FLOOR_LEAST_STEP = 0.5, 1.0
#: how much shares that only say how an effect acts are varied by
LEAST_SHARE = 0.2
#: times the misfit of the same cause elsewhere beyond which a place is given up
BEHIND = 1.1
#: how far beyond `large` a size may go
BEYOND = 2.5
#: places at which each cause is tried; and of those of which nobody knows which are likely
PLACES, PROMISING = 2, 3
#: the largest share that anything may take
WHOLE = 0.98


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


def robot_with(reference: Reference, hypothesis: Hypothesis, x: Sequence[Mapping[str, float]]) -> Robot:
    """The model with causes of these sizes."""
    robot = Robot(len(reference.torque), reference.low, reference.high)
    enter(robot, reference, [(part.cause, part.joints, point) for part, point in zip(hypothesis, x, strict=True)])
    return robot


@dataclass(frozen=True)
class Explained:
    """A cause fitted.

    Attributes:
        x: its coordinates; std: their standard deviations, from curvature alone.
        misfit: mean square of the whitened difference that is left.
    """

    part: Part
    x: Mapping[str, float]
    std: Mapping[str, float]
    misfit: float

    @property
    def beyond_tolerance(self) -> bool:
        """Whether it is larger than what healthy robots have."""
        sizes = [q for q in self.part.definition.quantities if not q.shape]
        return any(abs(self.x[q.name]) >= q.small for q in sizes)


@dataclass
class Scene:
    """The runs on which causes are compared, and the measure.

    Attributes:
        protocol: for sizes and scopes. runs: those simulated. metric: of their features, one after another.
        seen: (features,) of the robot at hand.
    """

    protocol: Protocol
    runs: Sequence[Played]
    metric: Metric
    seen: Floats

    def __post_init__(self) -> None:
        self._players = Players.of(self.runs)
        self._nominal = self._players.play([Robot(len(self.protocol.joints))])
        self._target = self.metric(self.seen[None])[0]

    def residuals(self, robots: Sequence[Robot]) -> Floats:
        """(robots, features) whitened differences between the robot at hand and these."""
        parts = [
            one.layout.features(found, nominal)
            for one, found, nominal in zip(self.runs, self._players.play(robots), self._nominal, strict=True)
        ]
        out: Floats = np.nan_to_num(self.metric(np.concatenate(parts, axis=1)) - self._target)
        return out


def scene_of(cause: str, scenes: Mapping[Setup, Scene]) -> Scene:
    """Where a cause shows."""
    if cause == HEAT:
        # Servos warm up from run to run, and most where they carry the robot.
        return max(scenes.values(), key=lambda scene: max(float(one.warm_c.max()) for one in scene.runs))
    # What shifts command and encoder alike shows where feet stand, and hardly anywhere else.
    floor = catalogue()[cause].of_body or catalogue()[cause].silent
    first = Setup.FLOOR if floor else Setup.STAND
    return scenes.get(first) or next(iter(scenes.values()))


def explain(
    scenes: Mapping[Setup, Scene], suspects: Sequence[str], judgement: Judgement, thorough: Sequence[str] = ()
) -> dict[str, Explained]:
    """The best place and size of each suspect by itself, of those to be `thorough` about of all places."""
    out: dict[str, Explained] = {}
    for scene in {id(s): s for s in scenes.values()}.values():
        known = {
            Part(name, where): x
            for name in suspects
            if scene_of(name, scenes) is scene
            for where, x in judgement.places[name][: _places_tried(name, thorough)]
        }
        for name in set(thorough) & {part.cause for part in known}:
            mine = [part for part in known if part.cause == name]
            robots = [robot_with(scene.protocol.reference, (part,), (known[part],)) for part in mine]
            misfit = np.square(scene.residuals(robots)).mean(axis=1)
            for n in np.argsort(misfit)[PROMISING:]:
                del known[mine[n]]
        if known:
            for one in fit(scene, known):
                name = one.part.cause
                if name not in out or one.misfit < out[name].misfit:
                    out[name] = one
    return out


def _places_tried(name: str, thorough: Sequence[str]) -> int | None:
    if catalogue()[name].random:
        # No simulation loses the very same commands: where it sits, only the judge can say.
        return 1
    return None if name in thorough else PLACES


@dataclass
class _Search:
    """One cause on its way; u: its coordinates in the order of its quantities; tangent: how the residual moves with each."""

    part: Part
    u: Array
    cost: float = np.inf
    residual: Floats | None = None
    done: bool = False
    tangent: Floats | None = None

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        return self.part.definition.quantities

    def robot(self, reference: Reference, u: Array) -> Robot:
        return robot_with(reference, (self.part,), (self.point(u),))

    def point(self, u: Array) -> dict[str, float]:
        return dict(zip([q.name for q in self.quantities], map(float, u), strict=True))


def fit(scene: Scene, starts: Mapping[Part, Mapping[str, float]]) -> list[Explained]:
    """Fit causes, each by itself, all of them side by side.

    Args:
        starts: coordinates from which each of them starts.
    """
    best = [_Search(part, np.array([x[q.name] for q in part.definition.quantities])) for part, x in starts.items()]
    _begin(scene, best)
    damping = np.full(len(best), DAMPING)
    for first in [True] + [False] * (ITERATIONS - 1):
        going = [k for k, search in enumerate(best) if not search.done]
        if not going:
            break
        tries = []
        for k in going:
            search = best[k]
            assert search.residual is not None
            assert search.tangent is not None
            normal, gradient = search.tangent @ search.tangent.T, search.tangent @ search.residual
            low, high = _bounds(search)
            moved = []
            # At first nobody knows how far tangents hold; later only where they did not.
            for scale in (1.0, 30.0) if first or damping[k] > CAUTIOUS else (1.0,):
                step = np.linalg.solve(
                    normal + damping[k] * scale * np.diag(np.diag(normal) + 1e-9), -gradient.astype(np.float64)
                )
                moved.append(_Search(search.part, np.clip(search.u + step, low, high)))
            tries.append(moved)
        _evaluate(scene, [one for moved in tries for one in moved])
        for k, moved in zip(going, tries, strict=True):
            found, *others = sorted(moved, key=lambda one: one.cost)
            search = tangent = best[k]
            for tried in (*others, found):
                tangent = _learnt(tangent, tried)
            if found.cost < search.cost:
                found.done = (search.cost - found.cost) < ENOUGH * search.cost
                best[k] = found
                damping[k] = max(damping[k] / 5, 1e-6)
            else:
                damping[k] *= 20
                search.done = damping[k] > 10
            best[k].tangent = tangent.tangent
        for search in best:
            least = min(other.cost for other in best if other.part.cause == search.part.cause)
            search.done |= search.cost > BEHIND * least
    return [_explained(search) for search in best]


def known_to(scene: Scene, one: Explained) -> Explained:
    """The same with how well its sizes are known there: a cause that only windows of the runs found has nothing to say of that."""
    search = _Search(one.part, np.array([one.x[q.name] for q in one.part.definition.quantities]))
    _begin(scene, [search])
    return dataclasses.replace(one, std=_explained(search).std)


def _learnt(search: _Search, tried: _Search) -> _Search:
    """The same with a tangent that foretells what was seen where it was tried, too (Broyden 1965)."""
    assert search.tangent is not None
    assert search.residual is not None
    assert tried.residual is not None
    # In steps of equal meaning: units differ.
    scale = np.maximum(np.linalg.norm(search.tangent, axis=1), 1e-12)
    step = (tried.u - search.u) * scale
    if not step @ step > 0:
        return search
    missed = tried.residual - search.residual - (tried.u - search.u) @ search.tangent
    tangent = search.tangent + np.outer(step * scale / (step @ step), missed).astype(np.float32)
    return dataclasses.replace(search, tangent=tangent)


def _bounds(search: _Search) -> tuple[Array, Array]:
    low, high = zip(*(bounds_of(q) for q in search.quantities), strict=True)
    return np.array(low), np.array(high)


def bounds_of(q: Quantity) -> tuple[float, float]:
    """Between which a coordinate is sought."""
    if q.share:
        return 0.0, 1.0
    if q.shape:
        return q.small / 2, q.large * 2
    # A share cannot be more than all.
    share = q.unit == "1" and not q.signed
    return -q.large * BEYOND if q.signed else 0.0, min(q.large * BEYOND, WHOLE) if share else q.large * BEYOND


def _evaluate(scene: Scene, searches: Sequence[_Search]) -> None:
    residuals = scene.residuals([search.robot(scene.protocol.reference, search.u) for search in searches])
    for search, residual in zip(searches, residuals, strict=True):
        _take(search, residual)


def _take(search: _Search, residual: Floats) -> None:
    search.residual, search.cost = residual, float(np.mean(np.square(residual)))


def _begin(scene: Scene, searches: Sequence[_Search]) -> None:
    """Evaluate searches where they start, and around: (coordinates, features) how the residual moves with each coordinate."""
    reference = scene.protocol.reference
    floor = any(one.plant.setup is Setup.FLOOR for one in scene.runs)
    share, least = (FLOOR_STEP, FLOOR_LEAST_STEP) if floor else (STEP, LEAST_STEP)
    robots, steps = [], []
    for search in searches:
        _low, high = _bounds(search)
        robots.append(search.robot(reference, search.u))
        mine = []
        for k, q in enumerate(search.quantities):
            # A shape may be small; a share that only says how an effect acts may be nothing.
            smallest = LEAST_SHARE if q.share else 0.0 if q.shape else least * q.small
            step = max(share * abs(search.u[k]), smallest)
            if search.u[k] + step > high[k]:
                step = -step
            u = search.u.copy()
            u[k] += step
            robots.append(search.robot(reference, u))
            mine.append(step)
        steps.append(mine)
    residuals = scene.residuals(robots)
    at = 0
    for search, mine in zip(searches, steps, strict=True):
        _take(search, residuals[at])
        around = residuals[at + 1 : at + 1 + len(mine)]
        search.tangent = (around - residuals[at]) / np.array(mine, np.float32)[:, None]
        at += 1 + len(mine)


def _explained(search: _Search) -> Explained:
    assert search.tangent is not None
    covariance = np.linalg.pinv((search.tangent @ search.tangent.T).astype(np.float64)) * max(search.cost, 1.0)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Explained(search.part, search.point(search.u), search.point(spread), search.cost)
