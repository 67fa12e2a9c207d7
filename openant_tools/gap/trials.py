"""What hypotheses close of the gap on folds that their fits have not seen: causes by themselves, then beside each other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.assess import Assessment
from openant_tools.gap.closure import Closure, closures
from openant_tools.gap.decide import Anomaly, Row
from openant_tools.gap.experiment import Experiment
from openant_tools.gap.fitting import Fits
from openant_tools.gap.hypothesis import Part, Refit, sized
from openant_tools.gap.prediction import Predictions

__all__ = ["Trials"]

Causes = tuple[str, ...]

#: causes whose first steps are simulated side by side: what each has learnt of every run stays in memory meanwhile
AT_ONCE = 5


@dataclass
class Trials:
    """Hypotheses that were fitted to a recording.

    Attributes:
        closures: causes → what they close; of none at all what a re-fit within tolerance does by itself.
        starts: causes → where their first steps have led. along: several causes → how far what the others leave goes along the last one.
    """

    experiment: Experiment
    assessment: Assessment
    fits: Fits
    closures: dict[Causes, Closure] = field(default_factory=dict)
    starts: dict[Causes, Refit] = field(default_factory=dict)
    along: dict[Causes, float] = field(default_factory=dict)

    @classmethod
    def of(cls, experiment: Experiment, assessment: Assessment) -> Trials:
        return cls(experiment, assessment, Fits(Predictions(experiment.parts, assessment.set_aside)))

    def fit(self, sets: Sequence[Causes]) -> None:
        """Fit sets of causes, each at its best place, on all parts but those of each fold; the first is what they are compared with.

        What acts at random times is told by what the others leave.
        """
        simulated = list(dict.fromkeys(_simulated(causes) for causes in sets))
        if not self.closures.keys() >= set(simulated) or simulated == list(sets):
            starts = [self._start(causes) for causes in simulated]
            done = closures(self.fits, starts, self.experiment.folds, self.experiment.training)
            self.closures |= zip(simulated, done, strict=True)
        self.closures |= {causes: self._at_random(causes) for causes in sets if _simulated(causes) != causes}

    def tells(self, name: str) -> bool:
        """Whether fits tell of a cause: not what no simulation repeats, nor what only a sensor shows that is not there."""
        effect = catalogue()[name]
        return not effect.random and (
            effect.of_body or not effect.unseen_in_joints or bool(self.fits.predictions.sensed)
        )

    def promise(self, sets: Sequence[Causes], base: Causes = ()) -> dict[str, float]:
        """Last cause of each → nats by which its first steps make what was measured likelier than what was fitted beside."""
        found = dict[str, float]()
        for n in range(0, len(sets), AT_ONCE):
            some = [_simulated(causes) for causes in sets[n : n + AT_ONCE]]
            starts, known = [self._start(causes) for causes in some], self.closures[_simulated(base)]
            begun = self.fits.begun(starts, self.experiment.training, known.refit.hypothesis)
            for causes, (refit, likelihood) in zip(some, begun, strict=True):
                self.starts[causes] = refit
                found[causes[-1]] = likelihood - known.likelihood
        return found

    @property
    def anomaly(self) -> Anomaly:
        """How far the recording is from the model, and without what its best cause explains: a template, or commands one by one."""
        known, base = self.assessment.evidence.anomaly, self.closures[()]
        random = [effect for name, effect in catalogue().items() if effect.random and name in self.assessment.fit]
        explained = max((base.explained(one) for one in random if base.irregular.nats(one) > 0), default=0.0)
        return replace(known, left=min(known.left, known.size * math.exp(-explained / base.joints)))

    def row(self, causes: Causes) -> Row:
        """What is known of the last of some causes, beside the others."""
        where = {part.cause: part.joints for part in self._start(_simulated(causes)).hypothesis}
        places = tuple(where.get(name) or self.assessment.place(name) for name in causes)
        fit = self.along[causes] if len(causes) > 1 else self.assessment.fit[causes[0]]
        if catalogue()[causes[-1]].random:
            effect, base = catalogue()[causes[-1]], self.closures[_simulated(causes)]
            at = base.irregular.joints(effect)
            return Row(
                causes, (*places[:-1], at), fit, irregular=self._irregular(causes), explained=base.explained(effect)
            )
        one, other = self.closures.get(causes), self.closures.get(causes[:-1])
        if one is None or other is None or not self.tells(causes[-1]):
            return Row(causes, places, fit)
        return Row(
            causes, places, fit, support=one.support(other), foretold=one.foretold, uneven=one.uneven,
            likelier=one.likelier(other), within=one.within - other.likelihood, gain=one.closed - other.closed,
        )  # fmt: skip

    def _irregular(self, causes: Causes) -> float:
        """nats by which what others leave is likelier with a cause that acts at random times.

        Beside whichever cause makes it least: what that explains by itself, as much of it as every robot has included, is that cause's part.
        """
        effect, base = catalogue()[causes[-1]], self.closures[_simulated(causes)]
        alone = base.irregular.nats(effect)
        others = [] if _simulated(causes) else [one for known, one in self.closures.items() if len(known) == 1]
        return min([alone, *(max(one.irregular.nats(effect), alone - max(one.likelier(base), 0.0)) for one in others)])

    def _at_random(self, causes: Causes) -> Closure:
        """What is closed beside causes that act at random times: as much as without them."""
        known = self.closures[_simulated(causes)]
        parts, x, std = list(known.refit.hypothesis), list(known.refit.x), list(known.std)
        for n, name in enumerate(causes):
            if (effect := catalogue()[name]).random:
                names = [q.name for q in effect.quantities]
                size, deviation = (
                    dict(zip(names, map(float, of), strict=True)) for of in known.irregular.sizes(effect)
                )
                parts.insert(n, Part(name, known.irregular.joints(effect)))
                x.insert(n, size)
                std.insert(n, deviation)
        return replace(known, refit=replace(known.refit, hypothesis=tuple(parts), x=tuple(x)), std=tuple(std))

    def none(self) -> Row:
        """What is known of no cause at all."""
        return Row((), uneven=self.closures[()].uneven)

    def removal(self, causes: Causes) -> dict[str, float]:
        """Of causes together, what closes less without each, the most first; of those that were tried without it."""
        whole, out = self.closures[causes], {}
        for name in causes:
            rest = tuple(other for other in causes if other != name)
            known = next((one for tried, one in self.closures.items() if set(tried) == set(rest)), None)
            if known is not None:
                out[name] = whole.closed - known.closed
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def size(self, name: str) -> Mapping[str, float]:
        """How large a cause would be by its best template's amplitude: where fits start from."""
        evidence = self.assessment.evidence
        amplitude = float(evidence.amplitudes[evidence.causes.index(name)])
        return sized(name, self.assessment.template(name), amplitude)

    def left(self, causes: Causes) -> list[tuple[Part, dict[str, float], float]]:
        """Where every cause would sit in what these, fitted, leave of the recording, as large as it is there, and in deviations of healthy
        robots how far that goes along it. The best fit first.
        """
        known, runs = self.closures[_simulated(causes)].refit, self.assessment.protocol.runs
        return self.assessment.further(
            [self.fits.predictions.robot(known, k, one.warm_c) for k, one in enumerate(runs)]
        )

    def further(self, causes: Causes) -> list[Causes]:
        """Those with one cause more, by what they leave of the recording: the best fit first, where and as large as it is there."""
        known, out = self.closures[_simulated(causes)].refit, []
        for part, x, fit in self.left(causes):
            if part.cause not in causes:
                out.append((*causes, part.cause))
                self.along[out[-1]] = fit
                start = Refit((*known.hypothesis, part), (*known.x, x), known.nuisance)
                self.starts.setdefault(_simulated(out[-1]), start)
        return out

    def _start(self, causes: Causes) -> Refit:
        """From what is known: the same, or it without its last cause, and that one as large as templates say."""
        if causes in self.closures:
            return self.closures[causes].refit
        if causes in self.starts:
            return self.starts[causes]
        if not causes:
            return self.fits.nothing()
        parts = [Part(name, self.assessment.place(name)) for name in causes]
        before = self.closures.get(causes[:-1]) if len(causes) > 1 else None
        if before is None:
            return self.fits.of(parts, [self.size(name) for name in causes])
        return Refit(tuple(parts), (*before.refit.x, self.size(causes[-1])), before.refit.nuisance)


def _simulated(causes: Causes) -> Causes:
    """Those that a simulation repeats."""
    return tuple(name for name in causes if not catalogue()[name].random)
