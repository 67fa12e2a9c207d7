"""The evidence of one recording: how far it is from the model, beyond what robots of one build are, and how far it goes along each cause.

Templates and healthy robots are simulated for the recording at hand and kept under a name that says all that they follow from; what
is simulated is counted in robots, never in seconds, so that the same recording gives the same answer on any computer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.arrays import read_arrays, write_arrays
from openant_tools.effects.robot import Robot
from openant_tools.errors import BadInput
from openant_tools.gap.cache import cache_folder, keep_small
from openant_tools.gap.ensemble import robot_at, robots_at, templates_at, templates_of
from openant_tools.gap.evidence import Evidence, Layouts, Scale, anomalies, evidence_of, unknown_signals
from openant_tools.gap.features import Floats
from openant_tools.gap.hypothesis import Part, sized
from openant_tools.gap.population import Case
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.refine import refined
from openant_tools.gap.templates import Template
from openant_tools.model.plant import Setup
from openant_tools.workers import tied

__all__ = ["Assessment", "assess", "layouts_of"]

Bools = NDArray[np.bool_]

#: healthy robots that make the measure, and others that say how far one may be outside it; robots of one batch
MEASURE, OTHERS, BATCH = 72, 24, 32
#: that templates are simulated in, beside each other
PARTS = 4
#: of simulated robots: raise it where the same recording gives others
VERSION = 11


@dataclass(frozen=True)
class Assessment:
    """What is known of a recording before anything is fitted.

    Attributes:
        evidence: how far it goes along each cause, and how far it is from the model.
        set_aside: signal → times the farthest healthy robot by which it behaves as none that is known: it had no part in this.
        anomalies: signal → how far it is from the model's, in what healthy robots are off by: above 1 beyond nearly all of them.
        protocol: the recording as it was simulated for that. scale: what it was measured by. seen: (features,) of the recording.
    """

    evidence: Evidence
    set_aside: Mapping[str, float]
    anomalies: Mapping[str, float]
    protocol: RunSet
    scale: Scale
    seen: Floats

    @cached_property
    def fit(self) -> Mapping[str, float]:
        """Cause → deviations of healthy robots by which the recording goes along it."""
        return dict(zip(self.evidence.causes, self.evidence.fit.tolist(), strict=True))

    @property
    def robots(self) -> int:
        """How many were simulated for it."""
        return len(self.evidence.bank) + MEASURE + OTHERS

    def place(self, cause: str) -> tuple[int, ...]:
        """Where its best template sits: indices of joints."""
        return self._best(cause)[1]

    def template(self, cause: str) -> Mapping[str, float]:
        """Coordinates of its best template."""
        return self._best(cause)[2]

    def further(self, robots: Sequence[Robot]) -> list[tuple[Part, dict[str, float], float]]:
        """Where every cause would sit, its coordinates, and how far what a robot leaves of the recording goes along it, in deviations of
        healthy robots. The best fit first.

        Args:
            robots: that robot as it was on each run, re-fitted with the causes that are known.
        """
        left = self.scale.whitened((self.seen - robot_at(self.protocol, robots))[None])
        templates = self.scale.templates
        fit, length = templates.fits(left)[0], np.linalg.norm(templates.vectors, axis=1)
        out = []
        for k in sorted((int(some[fit[some].argmax()]) for some in templates.of_cause), key=lambda k: -fit[k]):
            name, joints, x = templates.bank[k]
            out.append((Part(name, joints), sized(name, x, float(fit[k] / length[k])), float(fit[k])))
        return out

    def _best(self, cause: str) -> Template:
        return self.evidence.bank[int(self.evidence.places[self.evidence.causes.index(cause)])]


def assess(
    protocol: RunSet,
    progress: Callable[[float, str], None] = lambda share, words: None,
    jobs: int = -1,
    without: Collection[str] = (),
) -> Assessment:
    """Assess a recording (`Experiment.protocol`).

    Args:
        progress: told a share and words. jobs: processes; none of the result depends on it. without: signals that have no part in it.
    """
    coarse = protocol.coarse()
    bank = templates_of(coarse)
    name = f"recording-{_name(coarse)}"
    templates, healthy = _simulated(coarse, name, bank, progress, jobs)
    layouts = layouts_of(coarse)
    nominal = coarse.nominal()
    seen = np.concatenate([one.features(there) for one, there in zip(coarse.runs, nominal, strict=True)])
    known = np.concatenate([one.layout.known(one.seen) for one in coarse.runs])
    known = known & ~np.isin(layouts.signal, list(without))
    set_aside: dict[str, float] = {}

    def refined_with(known: Bools, cases: list[Case], features: Floats) -> tuple[list[Case], Floats]:
        progress(0.9, "what the likeliest causes do at their best sizes")
        scale = Scale.of(layouts, known, healthy[:MEASURE], features, cases, coarse.reference)
        more, found = refined(scale, seen, lambda cases: _more(coarse, name, cases, jobs))
        return [*cases, *more], np.concatenate([features, found])

    bank, templates = refined_with(known, bank, templates)
    while True:
        scale = Scale.of(layouts, known, healthy[:MEASURE], templates, bank, coarse.reference)
        beyond = unknown_signals(scale, healthy[MEASURE:], seen)
        if not beyond:
            break
        worst = max(beyond, key=lambda name: beyond[name])
        set_aside[worst] = beyond[worst]
        known = known & (layouts.signal != worst)
    if set_aside:  # what they said had a part in the sizes
        bank, templates = refined_with(known, bank, templates)
        scale = Scale.of(layouts, known, healthy[:MEASURE], templates, bank, coarse.reference)
    progress(1.0, "evidence")
    far = anomalies(scale, healthy[MEASURE:], seen)
    return Assessment(evidence_of(scale, seen), set_aside, far, coarse, scale, seen)


def layouts_of(protocol: RunSet) -> Layouts:
    """What the features of its runs are of."""
    signals = [(name, one) for one in protocol.runs for name in one.signals]
    counts = [len(one.layout.joints_of(name)) for name, one in signals]
    floor = [one.plant.setup is Setup.FLOOR for _, one in signals]
    return Layouts(np.repeat([name for name, _ in signals], counts), np.repeat(floor, counts))


def _simulated(
    protocol: RunSet, name: str, bank: list[Case], progress: Callable[[float, str], None], jobs: int
) -> tuple[Floats, Floats]:
    """(templates, features) and (healthy robots, features), of all runs side by side."""

    def make() -> dict[str, Floats]:
        work = _of_templates(protocol, bank)
        parts = len(work)
        healthy = [Case({}, seed) for seed in range(MEASURE + OTHERS)]
        work += [
            joblib.delayed(tied(robots_at))(protocol, healthy[n : n + BATCH], n) for n in range(0, len(healthy), BATCH)
        ]
        found = []
        for done in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
            found.append(np.concatenate(done, axis=1))
            progress(0.9 * len(found) / len(work), "what each cause does to this recording")
        return {"templates": np.concatenate(found[:parts]), "healthy": np.concatenate(found[parts:])}

    stored = _cached(name, make)
    return stored["templates"], stored["healthy"]


def _more(protocol: RunSet, name: str, cases: Sequence[Case], jobs: int) -> Floats:
    """(cases, features) of more templates."""

    def make() -> dict[str, Floats]:
        done = joblib.Parallel(n_jobs=jobs)(_of_templates(protocol, cases))
        return {"templates": np.concatenate([np.concatenate(part, axis=1) for part in done])}

    asked = hashlib.sha256(json.dumps([list(case.causes.items()) for case in cases]).encode()).hexdigest()
    return _cached(f"{name}-{asked[:12]}", make)["templates"]


def _of_templates(protocol: RunSet, cases: Sequence[Case]) -> list[object]:
    # As many parts on any computer, so that they come to the same.
    step = -(-len(cases) // PARTS)
    return [joblib.delayed(tied(templates_at))(protocol, cases[n : n + step]) for n in range(0, len(cases), step)]


def _cached(name: str, make: Callable[[], dict[str, Floats]]) -> Mapping[str, Floats]:
    """What was made once, under the name of all that it follows from."""
    place = cache_folder() / f"{name}.npz"
    if place.exists():
        try:
            stored = read_arrays(place)
            place.touch()  # used now
            return {key: stored[key] for key in stored}
        except (BadInput, OSError, KeyError):
            pass  # cut or another's: it is made anew
    made = make()
    write_arrays(place, made)
    keep_small(place)
    return made


def _name(protocol: RunSet) -> str:
    """Of everything that simulations of a recording follow from."""
    state = hashlib.sha256(f"{VERSION} {protocol.fingerprint()}".encode())
    for one in protocol.runs:
        state.update(json.dumps([str(one.plant.setup), one.windows, one.run.facts.heading_rad], default=float).encode())
        state.update(np.ascontiguousarray(one.run.t).tobytes())
        for name in sorted(one.run.columns):
            values = one.run.columns[name]
            if values.dtype.kind in "fiub":
                state.update(name.encode())
                state.update(np.ascontiguousarray(values, np.float64).tobytes())
    return state.hexdigest()[:24]
