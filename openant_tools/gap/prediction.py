"""What a re-fitted model says of runs: measured minus simulated, channel by channel.

The gap is measured as it is defined (formats, section 3): re-initialised from measurement twice a second, positions, held-out runs. Fits
are made, and judged, over whole windows, and by what sensors of the body say as well: a load or a slipping foot moves the body, and joints
hardly; and a body that has sunk into a soft floor would be put back where it is not by each new beginning.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import enter
from openant_tools.effects.robot import USUAL_NOISE, Form, Robot
from openant_tools.gap.features import COLUMNS, around_switching
from openant_tools.gap.hypothesis import Refit
from openant_tools.gap.nuisance import BRISTLE, BRISTLE_RAD, HEAT_LOSS, LESS, ONE_SIDED, UNWRITTEN, adjust, nuisances
from openant_tools.gap.protocol import Played, RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.model.floor import floors
from openant_tools.model.gap import HORIZON_S
from openant_tools.model.rollout import Rollouts

__all__ = ["Predictions"]

Array = NDArray[np.float64]

#: rad: no joint is farther off than in a simulation that fell apart
LOST_RAD = 10.0
#: rad, the least that a position is known to
LEAST_SIGMA_RAD = 2e-4
#: s, steps on the stand, where nothing is gained by larger ones but time: half a milliradian is lost in steps of 2.5 ms
STAND_STEP_S = 0.001
#: sensors of the body, and how many columns each has
SENSED = {name: len(columns) for name, columns in COLUMNS.items()}


class Predictions:
    """Runs cut into windows, and what models say of them that are re-fitted to them.

    Channels are the joints' positions, rad, and then what sensors of the body say, each column by itself.

    Args:
        protocol: the robot and its runs, at the model's own step. without: signals that have no part in it.

    Attributes:
        names: what of the model may move within tolerance. sensed: signals of the body that any run has, of the others.
        measured: of each run, (rows, channels); NaN where nobody knows what a servo had in mind (`around_switching`).
        form: what simulations are like in what no model says; forms: what it may be: dry friction holds, or gives before it slides.
        there: of each run, (rows,) which of them are simulated. floor: (joints,) rad, and whether it comes from repeats
            of the same commands (`from_repeats`), else from the sensors; sigma: (channels,) of sensors.
    """

    def __init__(self, protocol: RunSet, without: Collection[str] = ()) -> None:
        self.protocol = protocol
        option = protocol.runs[0].plant.model.opt
        own = Form(option.integrator, option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC, option.impratio)
        self.forms = own, dataclasses.replace(own, bristle=BRISTLE_RAD)
        self.form = own
        self.joints = len(protocol.joints)
        present = {name for one in protocol.runs for name in one.seen} - set(without)
        self.sensed = tuple(name for name in SENSED if name in present)
        self.names = nuisances(protocol, self.sensed)
        self._before: dict[int, Array] = {}
        self._rollouts = [_restarted([one]) for one in protocol.runs]
        self._whole = [
            begun if one.windows is None else _windows([one])
            for one, begun in zip(protocol.runs, self._rollouts, strict=True)
        ]
        self.there = [_rows(one) for one in self._whole]
        self._coarse = protocol.coarse(STAND_STEP_S).runs
        self._sets: dict[tuple[int, ...], list[tuple[tuple[int, ...], Rollouts]]] = {}
        self.measured = [self._measured(one) for one in protocol.runs]
        self.floor, self.from_repeats = floors([one.run for one in protocol.runs], protocol.joints)
        self.sigma = np.concatenate(
            [
                np.maximum(self.floor, LEAST_SIGMA_RAD),
                *(np.full(SENSED[name], USUAL_NOISE[name]) for name in self.sensed),
            ]
        )

    def robot(self, refit: Refit | None, k: int, warm_c: Array | None = None, *, written: bool = False) -> Robot:
        """As it is on run k; None: the model as it was given.

        Args:
            warm_c: (joints,) °C above the coolest run; default as warm as its servos were then.
            written: as a model of it is written, without what is asked only to tell causes apart.
        """
        reference = self.protocol.reference
        if refit is None:
            return Robot(len(self.protocol.joints), creeps=True)
        robot = Robot(len(self.protocol.joints), reference.low, reference.high)
        if not written:
            robot.form = self.form
        parts = zip(refit.hypothesis, refit.x, strict=True)
        # What acts at random times no simulation repeats.
        enter(robot, reference, [(part.cause, part.joints, x) for part, x in parts if not part.definition.random])
        for one, u in zip(self.names, refit.nuisance, strict=True):
            if one.name == HEAT_LOSS:
                left = 1 / (1 + one.value(float(u)) * (self.protocol.runs[k].warm_c if warm_c is None else warm_c))
                for kind in LESS:
                    robot.factor(kind)[:] *= left
            elif one.name in UNWRITTEN and written:
                continue
            elif one.name == BRISTLE:
                robot.form = dataclasses.replace(self.form, bristle=self.form.bristle * one.value(float(u)))
            elif u or one.name in ONE_SIDED:
                adjust(robot, one.name, one.joints, one.value(float(u)))
        return robot

    def errors(self, k: int, refits: Sequence[Refit | None]) -> Array:
        """(refits, rows, joints) rad, measured minus simulated on run k, begun anew as the gap is defined."""
        return self._errors([k], [self.robot(refit, k, written=True) for refit in refits], self._rollouts[k], ())[0]

    def over_windows(self, k: int, refits: Sequence[Refit]) -> Array:
        """(refits, rows, channels), measured minus simulated on run k, over whole windows."""
        return self._errors([k], [self.robot(refit, k) for refit in refits], self._whole[k], self.sensed)[0]

    def simulated(self, k: int, refit: Refit, signals: Sequence[str]) -> dict[str, Array]:
        """Signal → (rows, joints), what a re-fitted model does on run k."""
        found = simulate(
            self._rollouts[k],
            [self.robot(refit, k, written=True)],
            signals=signals,
            warm_c=[self.protocol.runs[k].warm_c],
        ).signals
        return {name: values[0].astype(np.float64) for name, values in found.items()}

    def before(self, k: int) -> Array:
        """(rows, joints) rad, errors of the model as it was given."""
        if k not in self._before:
            self._before[k] = self.errors(k, [None])[0]
        return self._before[k]

    def written(self, refit: Refit, judged: Sequence[int]) -> float:
        """The gap, rad, on these runs of the one model that can be written: its servos are always as warm as on average there."""
        warm = self.warmth(judged)
        errors = np.concatenate(
            [self._errors([k], [self.robot(refit, k, warm, written=True)], self._rollouts[k], ())[0][0] for k in judged]
        )
        return float(np.sqrt(np.mean(np.square(errors[np.isfinite(errors)]))))

    def warmth(self, judged: Sequence[int]) -> Array:
        """(joints,) °C above the coolest run, mean of some runs."""
        mean: Array = np.mean([self.protocol.runs[k].warm_c for k in judged], axis=0)
        return mean

    def _errors(
        self,
        runs: Sequence[int],
        robots: Sequence[Robot],
        rollouts: Rollouts,
        sensed: Sequence[str],
    ) -> list[Array]:
        """Of each run of a rollout (robots, rows, channels), measured minus simulated: of joints, and some sensors of the body."""
        warm_c = [self.protocol.runs[k].warm_c for k in runs]
        signals = simulate(rollouts, robots, signals=("pos", *sensed), warm_c=warm_c).signals
        pos = signals["pos"]
        absent = {name: np.full((*pos.shape[:2], width), np.nan) for name, width in SENSED.items()}
        found = np.concatenate([pos, *(signals.get(name, absent[name]) for name in sensed)], axis=2)
        measured = np.concatenate([self.measured[k][:, : found.shape[2]] for k in runs])
        out: Array = measured[None] - found.astype(np.float64)
        if "yaw" in sensed:
            out[..., self._of("yaw")] = np.remainder(out[..., self._of("yaw")] + np.pi, 2 * np.pi) - np.pi
        # A robot that no step holds together is as wrong as can be: neither right nor unknown.
        lost = _rows(rollouts)[:, None] & np.isfinite(measured[:, : self.joints]) & ~(np.abs(pos) < LOST_RAD)
        out[..., : self.joints][lost] = LOST_RAD
        return [out[:, rows] for rows in rollouts.rows]

    def coarse(self, runs: Sequence[int], robots: Sequence[Robot], rollouts: Rollouts) -> list[Array]:
        """Of each run (robots, rows, channels), as `over_windows`, of rollouts of `side_by_side`."""
        return self._errors(runs, robots, rollouts, self.sensed)

    def side_by_side(self, fitted: Sequence[int]) -> list[tuple[tuple[int, ...], Rollouts]]:
        """Runs that one simulation plays, in large steps, where fits follow them: those on one plant, if servos are alike in all."""
        key = tuple(fitted)
        if key not in self._sets:
            unlike = any(one.name == HEAT_LOSS for one in self.names)
            groups: dict[tuple[int, int], list[int]] = {}
            for k in fitted:
                one = self._coarse[k]
                groups.setdefault((id(one.plant), k if unlike or one.windows is None else -1), []).append(k)
            self._sets[key] = [(tuple(mine), _windows([self._coarse[k] for k in mine])) for mine in groups.values()]
        return self._sets[key]

    def _measured(self, one: Played) -> Array:
        """(rows, channels) of a run."""
        pos = np.where(
            around_switching(one.run, self.protocol.joints), np.nan, one.run.signal("pos", self.protocol.joints)
        )
        absent = {name: np.full((len(pos), width), np.nan) for name, width in SENSED.items()}
        body = [one.seen[name][0] if name in one.seen else absent[name] for name in self.sensed]
        return np.concatenate([pos, *body], axis=1)

    def _of(self, signal: str) -> slice:
        """Which channels a sensor of the body has."""
        first = self.joints + sum(SENSED[name] for name in self.sensed[: self.sensed.index(signal)])
        return slice(first, first + SENSED[signal])


def _restarted(runs: Sequence[Played]) -> Rollouts:
    """Runs on one plant, begun anew from measurement as the gap is defined: all of it, or what of it is simulated."""
    parts = []
    for one in runs:
        mine: list[tuple[float, float]] = []
        for start, stop in one.windows or ():
            edges = np.linspace(start, stop, max(1, round((stop - start) / HORIZON_S)) + 1).tolist()
            mine += itertools.pairwise(edges)
        parts.append(mine)
    return _rollouts(runs, parts)


def _windows(runs: Sequence[Played]) -> Rollouts:
    """Runs on one plant in whole windows."""
    return _rollouts(runs, [one.windows or () for one in runs])


def _rollouts(runs: Sequence[Played], windows: Sequence[Sequence[tuple[float, float]]]) -> Rollouts:
    whole = runs[0].windows is None
    return Rollouts(
        runs[0].plant,
        [one.run for one in runs],
        HORIZON_S if whole else None,
        windows=None if whole else windows,
    )


def _rows(rollouts: Rollouts) -> NDArray[np.bool_]:
    """(rows,) which of its runs' are simulated."""
    out = np.zeros(rollouts.rows[-1].stop, bool)
    for segment in rollouts.segments:
        out[segment.row] = True
    return out
