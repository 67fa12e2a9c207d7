"""A diagnosis in words: for the terminal, the report and the terminal program."""

from __future__ import annotations

import math
import re

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis, Found
from openant_tools.gap.regime import Regime
from openant_tools.model.gap import share_closed
from openant_tools.numbers import exact, number, percent, span

__all__ = [
    "BY_ITSELF",
    "LEAST_SHARE",
    "SIGNALS",
    "closed",
    "closing",
    "missing",
    "part_words",
    "rest_words",
    "restart_words",
    "sentence",
    "sizes",
    "standing",
    "what_next",
    "where_words",
]

#: signal of a place → what it is called
SIGNALS = {"pos": "position", "vel": "velocity"}
BY_ITSELF = "by itself it closes"
#: ends of the names of parameters in files → their unit
UNITS = {
    "rad": "rad", "rad_s": "rad/s", "nm": "N·m", "nm_rad": "N·m/rad", "n": "N", "n_s_m": "N·s/m", "m": "m", "kg": "kg", "s": "s",
    "ohm": "Ω", "per_c": "1/°C",
}  # fmt: skip
_UNIT = re.compile(rf"(?<=.)_({'|'.join(sorted(UNITS, key=len, reverse=True))})$")
#: share from which a part is most of the whole, and below which it is not worth a line
MOST, LEAST_SHARE = 0.5, 0.005


def part_words(share: float, joint: str, regime: Regime) -> str:
    """The largest part of a gap, as a sentence goes on after what "it" is."""
    part = "most of it" if share > MOST else "its largest part"
    return f"{part} ({percent(share)}) lies at {joint} while {regime.words}"


def restart_words(horizon_s: float | None) -> str:
    """From where a simulation goes on, whose gap is measured."""
    if horizon_s is None:
        return "The simulation starts once from what was measured, and then goes on by itself"
    return f"Every {exact(horizon_s, 's')} the simulation starts again from what was measured"


def sentence(found: Diagnosis) -> str:
    """The verdict, with its confidence."""
    sure = f"confidence {percent(found.confidence)}"
    if found.verdict == NONE:
        return f"Nothing beyond the floor is off by more than robots of one build differ ({sure})."
    by_name = {one.effect: one for one in reversed(found.effects)}
    if found.verdict == AMBIGUOUS:
        sets = "; ".join(" or ".join(group) for group in found.ambiguous_with)
        candidates = sets or " or ".join(one.effect for one in found.effects[:2])
        words = f"The gap is real, but these runs cannot tell its causes apart: {candidates} ({sure})."
        if not found.selected:
            return words
        return f"{words} With {' and '.join(found.selected)} in the model, {closing(closed(found))} of the gap closes on held-out runs."
    if found.verdict == UNEXPLAINED:
        best = _closest(found)
        closest = "" if best is None else f"; closest is {best.effect}" + (
            "" if best.gap_closed is None else f", which closes {closing(best.gap_closed)} of it"
        )  # fmt: skip
        left = f" {rest_words(found)}" if found.rest else ""
        return f"The gap is real, and nothing known here explains it{closest} ({sure}).{left}"
    one = by_name[found.verdict]
    words = f"{one.effect} ({where_words(one.joints)}): {catalogue()[one.effect].words}"
    beside = [name for name in found.selected if name != found.verdict]
    more = f", with {' and '.join(beside)} beside it" if beside else ""
    closes = f"closes {closing(closed(found))} of the gap on held-out runs."
    if catalogue()[one.effect].random and not beside:
        return f"{words} ({sure}). No model repeats that; with what else was fitted within tolerance the improved model {closes}"
    return f"{words}{more} ({sure}). The improved model {closes}"


def rest_words(found: Diagnosis) -> str:
    """What is left once the improved model has done what it can, and what that follows."""
    rest = found.rest
    low, high = rest["band_hz"]
    band = span(low, high, "Hz", decimals=1)
    text = f"What is left is largest at {rest['joint']}, {percent(rest['share'])} of it from {band}"
    if rest["regressor"] is None:
        return f"{text}; there it follows nothing that was looked at."
    return f"{text}; there {percent(rest['coherence'])} of it follows {rest['regressor']}."


def sizes(one: Found, *, interval: bool = True) -> str:
    """How large an effect is: each parameter by its name and in the unit that people read, with its interval if that is asked for."""
    effect = catalogue()[one.effect]
    units = {"direction": "rad"}
    units |= {q.name: q.unit for q in effect.quantities} | {p.name: p.unit for p in effect.parameters}
    out = []
    for name, found in one.parameters.items():
        end = _UNIT.search(name)
        unit = units.get(name) or (UNITS[end[1]] if end else "")
        ends = (found.low, found.high) if interval else (None, None)
        out.append(f"{re.sub(r'[._]', ' ', _UNIT.sub('', name))} {number(found.value, unit, *ends)}")
    return ", ".join(out)


def where_words(joints: tuple[str, ...] | str) -> str:
    """`all`, `body` or the joints."""
    return joints if isinstance(joints, str) else ", ".join(joints)


def closed(found: Diagnosis) -> float:
    """The share of the excess gap that the improved model closes; 0 where there is none."""
    share = share_closed(*(float(found.gap[name]) for name in ("before", "after", "floor")))
    return share if math.isfinite(share) else 0.0


def closing(share: float) -> str:
    """How much of the gap closes, as a share of what is above the floor: where it grows, and near the floor by many times that, nothing."""
    return "nothing" if share < 0.0 else percent(share)


def missing(share: float) -> str:
    """What comes of it where a share of what the improved model closes is left out."""
    return "as much closes without it" if share < LEAST_SHARE else f"without it {percent(share)} of the gap opens again"


def standing(found: Diagnosis, one: Found) -> str:
    """Why it is in the answer, or not."""
    if one.effect in found.refuted:
        return f"refuted: {found.refuted[one.effect]}"
    if found.verdict == UNEXPLAINED and one is _closest(found):
        return "closest, and not enough"
    if one.effect in found.selected:
        lost = found.removal.get(one.effect)
        return "in the improved model" + ("" if lost is None else f"; {missing(lost)}")
    if any(one.effect in group for group in found.ambiguous_with):
        return "these runs cannot tell"
    leads = next((other for other in found.effects if other.effect == found.verdict), None)
    if one.gap_closed is not None and leads is not None and leads.gap_closed is not None:
        return f"{BY_ITSELF} {closing(one.gap_closed)}, but {leads.effect} closes {closing(leads.gap_closed)}"
    if one.gap_closed is not None:
        return f"{BY_ITSELF} {closing(one.gap_closed)}, which is not enough"
    return f"of robots whose recordings look like this one, {percent(one.probability)} have it"


def _closest(found: Diagnosis) -> Found | None:
    """Of the effects considered, the best that no signature speaks against."""
    return next((one for one in found.effects if one.effect not in found.refuted), None)


def what_next(found: Diagnosis) -> str:
    """What to do now."""
    if found.next_experiment:
        return f"{found.next_experiment[:1].upper()}{found.next_experiment[1:]}."
    if found.verdict == NONE:
        return "Nothing: the model is as good as these runs can tell."
    return "Write the improved model with `openant gap apply`, and judge it by another motion, recorded for that."
