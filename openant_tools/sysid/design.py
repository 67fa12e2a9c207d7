"""D-optimal recordings: of many random motions, those that together say most about the parameters.

Motions that begin and end at rest add their information (a robot on its stand forgets within a fraction of a second), so that
every candidate is simulated once and only sums are compared. The row of motions is found by Fedorov's exchange
(Fedorov 1972, Theory of Optimal Experiments): each place in turn takes the candidate with the largest log determinant of the
precision of all parameters, priors included, until no exchange helps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.numbers import exact, percent
from openant_tools.sysid.excitation import (
    Around,
    Chirp,
    CommandSpace,
    Holds,
    Multisine,
    Releases,
    Rest,
    Segment,
    Sine,
    SlowReversals,
    Square,
    Steps,
)
from openant_tools.sysid.forecast import Forecast, forecast
from openant_tools.sysid.plan import Plan, Planned, information, make_plan, marginal, parameters_of
from openant_tools.sysid.protocols import Protocol

__all__ = ["Design", "design", "optimised"]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

#: s each motion of a design takes, and how many of them are drawn to choose from
SLOT_S = 4.0
CANDIDATES = 48
#: Hz, the band of smooth motions: below it a motion does not fit its time, above it a servo does not follow
LOWEST_HZ, HIGHEST_HZ = 0.25, 6.0
#: a servo that gives all it can for longer than this share of the time grows hot and shows its limit only
MOST_SATURATED = 0.6
#: s of rest on both sides of a candidate
REST_S = 0.2
#: a step of 2 ms is fine enough to compare motions by
STEP_S = 2e-3
_SWEEPS = 20


@dataclass(frozen=True)
class Design:
    """The motions chosen.

    Attributes:
        nats: ½ log det of posterior over prior precision, that the candidates' sums promise.
        considered, refused: how many motions were drawn, and how many of them must not be played.
    """

    protocol: Protocol
    nats: float
    considered: int
    refused: int


def design(asked: Planned, seconds: float, progress: Progress | None = None) -> Design:
    """The best recording on the stand of about `seconds`, among motions drawn by the plan's seed.

    Raises:
        BadInput: too short for two motions, or all motions are refused.
    """
    slots = int((seconds - Protocol("", "", ()).seconds) / SLOT_S + 1e-9)
    if slots < 2:
        raise BadInput(
            f"{exact(seconds, 's')} hold no two motions", remedy=f"give it {exact(2 * SLOT_S + 3, 's')} or more"
        )
    plant = load_plant(asked.model, asked.space.joints, Setup.STAND, electrical=True)
    plant.model.opt.timestep = max(plant.timestep, STEP_S)
    drawn = _candidates(asked.space, np.random.default_rng(asked.seed))
    played = [Protocol("design", "", (Rest(REST_S), segment, Rest(REST_S))) for segment in drawn]
    expected, parameters = parameters_of(asked, played, plant)
    forecasts: list[Forecast] = []
    for number, protocol in enumerate(played):
        if progress:
            progress(0.4 * number / len(drawn), "simulating motions")
        forecasts.append(_alone(expected, asked, protocol, number))
    good = [k for k, one in enumerate(forecasts) if not _refused(one)]
    if not good:
        raise BadInput("no motion may be played within these limits", remedy="widen min_rad and max_rad in robot.toml")
    if progress:
        progress(0.4, "what each motion says")
    says = information(plant, [forecasts[k].run for k in good], parameters, asked.residual)
    if progress:
        progress(0.95, "choosing")
    kinds = [type(_core(drawn[k])).__name__ for k in good]
    chosen, nats = _exchange(says, kinds, slots, len(parameters))
    # Releases last: a leg that was caught need not be waited for.
    segments = sorted((drawn[good[k]] for k in chosen), key=lambda segment: isinstance(_core(segment), Releases))
    words = f"D-optimal for {len(parameters)} parameters within this robot's limits"
    return Design(Protocol("designed", words, tuple(segments)), nats, len(drawn), len(drawn) - len(good))


def optimised(asked: Planned, played: Sequence[Protocol], progress: Progress | None = None) -> Plan:
    """A plan whose motions on the stand are chosen anew in the same time, where those say more; its first note says what came of it.

    Raises:
        BadInput: nothing is on the stand, or as `design`.
    """
    stand = [one for one in played if one.setup == "stand"]
    if not stand:
        raise BadInput("there is nothing on the stand to optimise", remedy="leave out --optimise, or --setup floor")
    plan = make_plan(asked, played, progress)
    found = design(asked, sum(one.seconds for one in stand), progress)
    better = make_plan(asked, (found.protocol, *(one for one in played if one.setup == "floor")), progress)
    name = stand[0].name
    words = f"none of {found.considered} motions together say more than {name}: it stays"
    if better.nats > plan.nats and not better.objections:
        words = (
            f"of {found.considered} motions ({found.refused} refused), {len(found.protocol.segments)} were chosen: "
            f"intervals narrower by {percent(_narrower(plan, better))} in the mean than of {name}"
        )
        plan = better
    return replace(plan, notes=(words, *plan.notes))


def _narrower(before: Plan, after: Plan) -> float:
    """By what share intervals shrink, geometric mean over the parameters that both know of."""
    widths = {one.name: one.high - one.low for one in before.expectations}
    ratios = [
        np.log((one.high - one.low) / widths[one.name])
        for one in after.expectations
        if widths.get(one.name, 0.0) > 0 and one.high > one.low
    ]
    return float(1 - np.exp(np.mean(ratios))) if ratios else 0.0


def _candidates(space: CommandSpace, chance: np.random.Generator) -> list[Segment]:
    """Motions of every kind, their amplitudes, bands and middles drawn at random."""

    def between(low: float, high: float) -> float:
        return round(float(np.exp(chance.uniform(np.log(low), np.log(high)))), 3)

    kinds: tuple[Callable[[], Segment], ...] = (
        lambda: Multisine(
            SLOT_S, low_hz=between(LOWEST_HZ, 1.0), high_hz=between(2.0, HIGHEST_HZ), share=between(0.3, 0.9)
        ),
        lambda: Chirp(
            SLOT_S, low_hz=between(LOWEST_HZ, 1.0), high_hz=between(2.0, HIGHEST_HZ), share=between(0.3, 0.9)
        ),
        lambda: Steps(SLOT_S, every_s=between(0.5, 1.2), largest_rad=between(0.1, 1.0)),
        lambda: Holds(SLOT_S, move_s=between(0.3, 0.6), hold_s=between(0.4, 1.2), share=between(0.5, 0.9)),
        lambda: SlowReversals(SLOT_S, speed_rad_s=between(0.08, 0.5), amplitude_rad=between(0.06, 0.4)),
        lambda: Sine(SLOT_S, hz=between(0.5, HIGHEST_HZ), share=between(0.3, 0.9)),
        lambda: Square(SLOT_S, hz=between(0.5, 2.0), amplitude_rad=between(0.05, 0.4)),
        lambda: Releases(SLOT_S, speed_rad_s=between(0.8, 3.0), share=between(0.3, 0.8), limp_s=between(0.3, 1.0)),
    )
    out: list[Segment] = []
    for k in range(CANDIDATES):
        segment = kinds[k % len(kinds)]()
        if k // len(kinds) % 2 and not isinstance(segment, Releases):
            shares = tuple(round(float(share), 2) for share in chance.uniform(-0.5, 0.5, len(space.joints)))
            segment = Around(SLOT_S, segment, shares)
        out.append(segment)
    return out


def _core(segment: Segment) -> Segment:
    return segment.of if isinstance(segment, Around) else segment


def _alone(expected: Plant, asked: Planned, protocol: Protocol, number: int) -> Forecast:
    """A motion by itself, about the middle of the space."""
    space = asked.space
    middle = replace(space, home=space.centre)
    commands = protocol.commands(middle, asked.rate_hz, asked.seed + number)
    limp = protocol.limp(middle, asked.rate_hz)
    edge = (len(commands) - round(sum(part.seconds for part in protocol.segments) * asked.rate_hz)) // 2
    inside = slice(edge, len(commands) - edge)
    return forecast(expected, protocol, space, commands[inside], limp[inside], asked.rate_hz, f"motion-{number}")


def _refused(one: Forecast) -> bool:
    return bool(one.objections) or any(peak.saturated > MOST_SATURATED for peak in one.peaks)


def _exchange(says: Sequence[Array], kinds: Sequence[str], slots: int, n: int) -> tuple[list[int], float]:
    """Which candidates to play, and ½ log det of the precision of the first n numbers.

    No kind of motion fills more than a third of the places: what is best if the model is right is poor where it is not,
    and one kind of motion alone leads a fit, and a diagnosis even more, astray.
    """
    most = max(1, slots // 3)

    def worth(total: Array) -> float:
        return -0.5 * float(np.linalg.slogdet(marginal(total, n))[1])

    def open_to(others: Sequence[int]) -> list[int]:
        return [k for k in range(len(says)) if sum(kinds[other] == kinds[k] for other in others) < most] or list(
            range(len(says))
        )

    chosen: list[int] = []
    total = np.zeros_like(says[0])
    for _ in range(slots):
        best = max(open_to(chosen), key=lambda k: worth(total + says[k]))
        chosen.append(best)
        total = total + says[best]
    value = worth(total)
    for _ in range(_SWEEPS):
        before = value
        for place, now in enumerate(chosen):
            rest = total - says[now]
            best = max(open_to(chosen[:place] + chosen[place + 1 :]), key=lambda k: worth(rest + says[k]))
            if worth(rest + says[best]) > value + 1e-9:
                chosen[place], total = best, rest + says[best]
                value = worth(total)
        if value <= before + 1e-6:
            break
    return chosen, value
