"""Rollouts with effects that act between steps.

The same runs, segments, clocks and samples as `model.rollout`, whose contract holds here too; only that every step is
taken singly, for all simulations together, and laws act before each. It costs some tens of microseconds a step, however
many simulations there are: few variants of one pendulum are ten times slower than without laws, many of a whole robot
hardly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import effect
from openant_tools.effects.servos import batch_of
from openant_tools.effects.step import Law
from openant_tools.model.rollout import Rollouts, Trajectories

__all__ = ["EffectValues", "laws_of", "rollout"]

Array = NDArray[np.float64]
#: steps whose commands are laid out at a time
CHUNK = 256
#: joints of all simulations together from which a step is worth more than one thread
WORTH_THREADS = 200
#: (effect, parameter) → value per joint, (joints,)
EffectValues = Mapping[tuple[str, str], Array]


def laws_of(values: Sequence[EffectValues], joints: int) -> list[Law]:
    """The laws for simulations with these values each, in the order in which they act.

    Args:
        values: one mapping a simulation; what one lacks is 0 there.
        joints: how many there are.
    """
    names = {name for one in values for (name, _), value in one.items() if np.any(value)}
    laws = []
    for found in sorted((effect(name) for name in names), key=lambda found: found.order):
        table = {
            parameter.name: np.array(
                [np.broadcast_to(one.get((found.name, parameter.name), 0.0), joints) for one in values], float
            )
            for parameter in found.parameters
        }
        assert found.law is not None
        laws.append(found.law(table))
    return laws


def rollout(
    rollouts: Rollouts,
    models: Sequence[mujoco.MjModel],
    effects: Sequence[EffectValues],
    delays: Array | None = None,
    *,
    measured_supply: bool = False,
) -> Trajectories:
    """Roll out every run on each of `models`, with that variant's effects.

    Args:
        rollouts: the runs, prepared.
        models: variants of the plant's model.
        effects: each variant's.
        delays: (variants, joints) s, as `Rollouts` takes them.
        measured_supply: gains and torque limits follow the logged voltage where a run has it, from its nominal supply on.
    """
    plant, segments, nv = rollouts.plant, rollouts.segments, len(models)
    lengths = np.array([len(segment.control) for segment in segments])
    longest, timestep = int(lengths[0]), plant.timestep
    # Threads meet after every step: what few joints take is less than waiting for each other.
    few = len(segments) * nv * len(plant.joints) < WORTH_THREADS
    lean = [rollouts.lean(model) for model in models]
    batch, servos = batch_of(plant, lean, len(segments), 1 if few else rollouts.nthread)
    batch.state[:] = np.repeat([segment.state for segment in segments], nv, axis=0)
    batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
    ctrl, time = batch.bind("ctrl"), np.zeros(len(segments) * nv)
    laws = laws_of([effects[v] for _ in segments for v in range(nv)], len(plant.joints))
    supply = _Supply(rollouts, nv) if measured_supply else None
    samples = _Samples(rollouts, nv)
    flips: dict[int, list[tuple[slice, NDArray[np.bool_]]]] = {}
    for s, segment in enumerate(segments):
        for step, off in segment.switches(timestep).items():
            flips.setdefault(step, []).append((slice(s * nv, (s + 1) * nv), off))
    control: Array = np.empty(0)
    before = servos.state
    # Segments come longest first: at each step the first so many go on. None is all of them.
    active, ids = len(segments), None
    for step in range(longest):
        if lengths[active - 1] <= step:
            active = int((lengths > step).sum())
            ids = np.arange(active * nv, dtype=np.int32)
        if step % CHUNK == 0:
            control = _controls(rollouts, active, nv, step, min(step + CHUNK, longest), delays)
        for rows, off in flips.get(step, ()):
            servos.switch(rows, off)
        ctrl[: active * nv] = control[: active * nv, step % CHUNK]
        servos.prepare(laws, time, before, None if supply is None else supply.share(step))
        batch.step(ids=ids)
        time += timestep
        after = servos.state
        samples.take(step, before, after)
        before = after
    return Trajectories(samples.pos, samples.vel, rollouts.rows)


def _controls(rollouts: Rollouts, active: int, nv: int, begin: int, end: int, delays: Array | None) -> Array:
    """(active · variants, steps, nu) of the longest segments, the ends of the shorter ones padded."""
    control = np.zeros((active, nv, end - begin, rollouts.plant.model.nu))
    for s, segment in enumerate(rollouts.segments[:active]):
        part = segment.control[begin:end]
        control[s, :, : len(part)] = part
    if delays is not None:
        rollouts.delay(control, delays, begin)
    return control.reshape(active * nv, end - begin, -1)


class _Supply:
    """The logged voltage over the nominal one, at every step of every segment; 1 where either is unknown."""

    def __init__(self, rollouts: Rollouts, nv: int) -> None:
        plant, h = rollouts.plant, rollouts.plant.timestep
        longest = max(len(segment.control) for segment in rollouts.segments)
        self._nv = nv
        self._share = np.ones((len(rollouts.segments), longest, len(plant.joints)), np.float32)
        for s, segment in enumerate(rollouts.segments):
            run = rollouts.runs[segment.run]
            nominal = run.facts.supply_v
            if not nominal:
                continue
            times = segment.start + h * (np.arange(len(segment.control)) + 0.5)
            for j, volts in enumerate(run.signal("volt", plant.joints).T):
                seen = np.isfinite(volts) & (volts > 0)
                if seen.any():
                    self._share[s, : len(times), j] = np.interp(times, run.t[seen], volts[seen]) / nominal

    def share(self, step: int) -> Array:
        """(segments · variants, joints) at a step."""
        return self._share[:, step].astype(np.float64).repeat(self._nv, axis=0)


class _Samples:
    """Positions and velocities at the rows of all runs, taken as the steps on both sides of a row become known."""

    def __init__(self, rollouts: Rollouts, nv: int) -> None:
        segments, nj = rollouts.segments, len(rollouts.plant.joints)
        step = np.concatenate([segment.step for segment in segments])
        order = np.argsort(step, kind="stable")
        self._edges: list[int] = np.searchsorted(step[order], np.arange(int(step.max()) + 2)).tolist()
        whose = np.repeat(np.arange(len(segments)), [len(segment.step) for segment in segments])
        self._segment = whose[order]
        self._row = np.concatenate([segment.row for segment in segments])[order]
        self._fraction = np.concatenate([segment.fraction for segment in segments])[order]
        shape = (rollouts.rows[-1].stop, nv, nj)
        self._pos, self._vel = np.full(shape, np.nan), np.full(shape, np.nan)
        self._by_segment = len(segments), nv, nj

    @property
    def pos(self) -> Array:
        """(variants, rows, joints) rad."""
        return np.ascontiguousarray(self._pos.swapaxes(0, 1))

    @property
    def vel(self) -> Array:
        """(variants, rows, joints) rad/s."""
        return np.ascontiguousarray(self._vel.swapaxes(0, 1))

    def take(self, step: int, before: tuple[Array, Array], after: tuple[Array, Array]) -> None:
        """Note the rows between the states (positions, velocities) before and after a step."""
        here = slice(self._edges[step], self._edges[step + 1])
        if here.start == here.stop:
            return
        segment, row, share = self._segment[here], self._row[here], self._fraction[here][:, None, None]
        for out, a, b in ((self._pos, before[0], after[0]), (self._vel, before[1], after[1])):
            first, second = a.reshape(self._by_segment)[segment], b.reshape(self._by_segment)[segment]
            out[row] = first * (1 - share) + second * share
