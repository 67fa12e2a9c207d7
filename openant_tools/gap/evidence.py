"""How far a robot goes along what each cause does to its recording, in the measure of healthy robots: a matched filter.

What tolerances can explain is taken out first (`gap.whitening`). Nothing here is learned: how this evidence weighs beside that of fits is
(`gap.decide`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.robot import Reference
from openant_tools.gap.decide import Anomaly
from openant_tools.gap.features import COLUMNS, Floats
from openant_tools.gap.population import Case
from openant_tools.gap.templates import Template, Templates
from openant_tools.gap.whitening import Whitening, whiten

__all__ = ["Evidence", "Layouts", "Scale", "anomalies", "evidence_of", "unknown_signals"]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

SIGNALS = ("pos", "vel", "torque", "volt", *COLUMNS)
#: causes that may explain a signal, and times the farthest healthy robot beyond which it is unknown
EXPLAINING, OUTSIDE_HEALTHY = 3, 1.3
#: of healthy robots that are within what most of them are off by
QUANTILE = 0.95


@dataclass(frozen=True)
class Layouts:
    """The features of all runs, side by side.

    Attributes:
        signal: (features,) names. floor: whether its run stood on the floor.
    """

    signal: NDArray[np.str_]
    floor: Bools

    def only(self, some: Bools) -> Layouts:
        """Those features."""
        return Layouts(self.signal[some], self.floor[some])


@dataclass(frozen=True)
class Evidence:
    """How far one robot goes along each cause.

    Attributes:
        causes: names, those that can show on this recording.
        fit: (causes,) deviations of healthy robots along the template of each that fits best.
        places: (causes,) that template, an index into `bank`. amplitudes: how many times it; deviations: their standard deviations.
        anomaly: how far it is from the model, whatever it goes along. bank: what templates are of.
    """

    causes: tuple[str, ...]
    fit: Floats
    places: Ints
    amplitudes: Floats
    deviations: Floats
    anomaly: Anomaly
    bank: tuple[Template, ...]


@dataclass(frozen=True)
class Scale:
    """What evidence is measured by: healthy robots and templates of one recording, and which of its features are used.

    Attributes:
        layouts: of the features that are used. some: which those are, of all.
    """

    layouts: Layouts
    some: Bools
    whitening: Whitening
    templates: Templates

    @classmethod
    def of(
        cls,
        layouts: Layouts,
        known: Bools,
        healthy: Floats,
        templates: Floats,
        bank: Sequence[Case],
        reference: Reference,
    ) -> Scale:
        """
        Args:
            known: (features,) which of them are used. healthy: (robots, features). templates: (templates, features).
        """
        h, t = healthy[:, known].astype(np.float32), templates[:, known].astype(np.float32)
        whitening = whiten(h, t, bank, reference)
        listed = [(name, at, x) for case in bank for name, (at, x) in case.causes.items()]
        found = Templates.of(listed, whitening.of_templates(t))
        return cls(layouts.only(known), known, whitening, found)

    def whitened(self, features: Floats) -> Floats:
        """(robots, used features) of what was seen of robots (robots, features)."""
        return self.whitening(features[:, self.some].astype(np.float32))

    def vectors(self, templates: Floats) -> Floats:
        """(templates, used features) of robots without scatter, (templates, features)."""
        return self.whitening.of_templates(templates[:, self.some].astype(np.float32))


def evidence_of(scale: Scale, features: Floats) -> Evidence:
    """The evidence of a robot of which features (features,) were seen."""
    z, t = scale.whitened(features[None]), scale.templates
    fit = t.fits(z)[0]
    best = np.array([some[fit[some].argmax()] for some in t.of_cause])
    length, root = np.maximum(np.linalg.norm(t.vectors, axis=1), 1e-6), float(np.sqrt(z.shape[1]))
    size, left = (float(np.linalg.norm(of)) / root for of in (z[0], t.without_best(z[0], 1)))
    # What the best causes leave is as large as the noise that an amplitude is known by.
    deviations = max(size, 1.0) / length[best]
    return Evidence(t.causes, fit[best], best, fit[best] / length[best], deviations, Anomaly(size, left), t.bank)


def anomalies(scale: Scale, healthy: Floats, features: Floats) -> dict[str, float]:
    """Signal → how far it is from the model's, as a factor of what most healthy robots (QUANTILE of them) are off by at most.

    Args:
        healthy: (robots, features) not those of the scale. features: (features,) of the robot at hand.
    """
    z = scale.whitened(np.vstack([healthy, features]))
    out = {}
    for signal in SIGNALS:
        size = np.linalg.norm(z[:, scale.layouts.signal == signal], axis=1)
        usual = float(np.quantile(size[:-1], QUANTILE))
        if usual > 0:  # what no robot differs in says nothing
            out[signal] = float(size[-1]) / usual
    return out


def unknown_signals(scale: Scale, healthy: Floats, features: Floats) -> dict[str, float]:
    """Signals that behave as none that is known: signal → how far outside healthy robots', as a factor.

    Beyond what the likeliest causes do, a signal of a sensor stays outside everything that healthy robots with sensors of all
    forms show. What is known of it so is wrong, and it may lend no certainty to anything.

    Args:
        healthy: (robots, features) not those of the scale. features: (features,) of the robot at hand.
    """
    layouts, t = scale.layouts, scale.templates
    z = scale.whitened(np.vstack([healthy, features]))
    left = t.without_best(z[-1], EXPLAINING)
    out = {}
    for signal in SIGNALS[1:]:
        beyond = 0.0
        for floor in (False, True):
            mine = (layouts.signal == signal) & (layouts.floor == floor)
            usual = float(np.linalg.norm(z[:-1, mine], axis=1).max())
            if usual > 0:
                beyond = max(beyond, float(np.linalg.norm(left[mine])) / usual)
        if beyond > OUTSIDE_HEALTHY:
            out[signal] = beyond
    return out
