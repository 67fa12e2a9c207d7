"""A diagnosis as it is handed on: JSON of formats, section 2, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from openant_tools.effects.catalogue import catalogue
from openant_tools.errors import BadInput
from openant_tools.files import read_json
from openant_tools.numbers import stored

__all__ = ["AMBIGUOUS", "NONE", "SCHEMA", "UNEXPLAINED", "Diagnosis", "Found", "Span", "read_diagnosis"]

SCHEMA = "openant.gap/1"
NONE, AMBIGUOUS, UNEXPLAINED = "none", "ambiguous", "unexplained"


@dataclass(frozen=True)
class Span:
    """A parameter with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Found:
    """One effect considered.

    Attributes:
        joints: names, or "all" or "body".
        probability: the judge's, that it is present beyond tolerance.
        gap_closed: share of the excess gap that it alone closes on held-out runs, with its interval; None where it was not
            tried by itself.
        native: whether a written MJCF carries it.
        coordinates: of its fit, by which it is entered into simulations again.
    """

    effect: str
    joints: tuple[str, ...] | str
    parameters: Mapping[str, Span]
    probability: float
    gap_closed: float | None
    gap_closed_low: float | None
    gap_closed_high: float | None
    native: bool
    coordinates: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a simulation, as far as runs can tell.

    Attributes:
        effects: every one considered, best first.
        selected: those that go into the improved model, first the one whose removal costs most.
        ambiguous_with: sets that these runs cannot tell apart.
        gap: "before", "after", "floor" in rad, "floor_from" ("repeats" of the same commands or "sensors"), "signals" besides.
        where: shares of the excess, largest first, with what the improved model leaves there, if there is one.
        rest: what that leaves, and what it follows (`gap.residual.Residual`); empty where nothing was fitted.
        calibration: kind → joint → factor or amount that the re-fit within tolerance found, for the improved model.
        refuted: effect → what signature speaks against it, in words.
        notes: what it rests on, and what more signals would add.
        sensors: what was found about signals, and whether they had a part in the verdict.
        rows: what was decided on, see `gap.decide.Row`. anomaly: `gap.decide.Anomaly`.
        declined: in the same form what was asked for beside what had been chosen, and not added.
    """

    model: str
    runs: tuple[str, ...]
    held_out: tuple[str, ...]
    verdict: str
    confidence: float
    effects: tuple[Found, ...]
    selected: tuple[str, ...]
    ambiguous_with: tuple[tuple[str, ...], ...]
    next_experiment: str | None
    gap: Mapping[str, Any]
    where: Sequence[Mapping[str, Any]]
    calibration: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    removal: Mapping[str, float] = field(default_factory=dict)
    refuted: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    rest: Mapping[str, Any] = field(default_factory=dict)
    sensors: Sequence[Mapping[str, Any]] = ()
    rows: Sequence[Mapping[str, Any]] = ()
    declined: Sequence[Mapping[str, Any]] = ()
    anomaly: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """As formats, section 2, has it; what is ours alone comes after."""
        return {
            "schema": SCHEMA,
            "model": self.model,
            "runs": list(self.runs),
            "held_out": list(self.held_out),
            "verdict": self.verdict,
            "confidence": round(self.confidence, 4),
            "effects": [
                {
                    "effect": one.effect,
                    "joints": one.joints if isinstance(one.joints, str) else list(one.joints),
                    "parameters": {
                        name: {"value": _number(span.value), "low": _number(span.low), "high": _number(span.high)}
                        for name, span in one.parameters.items()
                    },
                    "probability": round(one.probability, 4),
                    "gap_closed": _number(one.gap_closed),
                    "gap_closed_low": _number(one.gap_closed_low),
                    "gap_closed_high": _number(one.gap_closed_high),
                    "native": one.native,
                    "coordinates": {name: _number(value) for name, value in one.coordinates.items()},
                }
                for one in self.effects
            ],
            "selected": list(self.selected),
            "ambiguous_with": [list(group) for group in self.ambiguous_with],
            "sensors": [dict(one) for one in self.sensors],
            "next_experiment": self.next_experiment,
            "gap": dict(self.gap),
            "where": [dict(place) for place in self.where],
            "calibration": {kind: dict(values) for kind, values in self.calibration.items()},
            "removal": {name: _number(value) for name, value in self.removal.items()},
            "rest": dict(self.rest),
            "refuted": dict(self.refuted),
            "notes": list(self.notes),
            "rows": [dict(row) for row in self.rows],
            "declined": [dict(row) for row in self.declined],
            "anomaly": dict(self.anomaly),
        }


def read_diagnosis(path: Path) -> Diagnosis:
    """A diagnosis from its JSON; raises BadInput where it is none."""
    try:
        text = read_json(path, "name the JSON of `openant gap diagnose`")
    except OSError as error:
        raise BadInput(
            error.strerror or str(error), where=path, remedy="name the JSON of `openant gap diagnose`"
        ) from None
    if not isinstance(text, dict) or text.get("schema") != SCHEMA:
        raise BadInput(
            f"is no diagnosis (schema {SCHEMA!r})", where=path, remedy="name the JSON of `openant gap diagnose`"
        )
    try:
        for name in (one["effect"] for one in text["effects"]):
            if name not in catalogue():
                raise BadInput(
                    f"it tells of an effect that is not known here: {name!r}", where=path,
                    remedy="make it anew with `openant gap diagnose`",
                )  # fmt: skip
        effects = tuple(
            Found(
                effect=str(one["effect"]),
                joints=one["joints"] if isinstance(one["joints"], str) else tuple(one["joints"]),
                parameters={
                    name: Span(_told(span["value"]), _told(span["low"], -math.inf), _told(span["high"]))
                    for name, span in one["parameters"].items()
                },
                probability=float(one["probability"]),
                gap_closed=one["gap_closed"],
                gap_closed_low=one["gap_closed_low"],
                gap_closed_high=one["gap_closed_high"],
                native=bool(one["native"]),
                coordinates={name: float(value) for name, value in one.get("coordinates", {}).items()},
            )
            for one in text["effects"]
        )
        return Diagnosis(
            model=str(text["model"]), runs=tuple(text["runs"]), held_out=tuple(text["held_out"]),
            verdict=str(text["verdict"]), confidence=float(text["confidence"]), effects=effects,
            selected=tuple(text["selected"]), ambiguous_with=tuple(tuple(group) for group in text["ambiguous_with"]),
            next_experiment=text["next_experiment"], gap=text["gap"], where=text["where"],
            calibration=text.get("calibration", {}), removal=text.get("removal", {}), notes=tuple(text.get("notes", ())),
            rest=text.get("rest", {}), sensors=tuple(text.get("sensors", ())), refuted=text.get("refuted", {}),
            rows=tuple(text.get("rows", ())),
            declined=tuple(text.get("declined", ())),
            anomaly=text.get("anomaly", {}),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(
            f"lacks or misstates {error}", where=path, remedy="make it anew with `openant gap diagnose`"
        ) from None


def _told(value: float | None, unknown: float = math.inf) -> float:
    """A number of JSON, which has none for a limit that is nowhere and for an end that nobody knows."""
    return unknown if value is None else float(value)


def _number(value: float | None) -> float | None:
    """A JSON number; what is infinite or unknown has none."""
    return stored(value) if value is not None and math.isfinite(value) else None
