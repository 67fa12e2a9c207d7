"""All that a run says of the time to come, as it is asked for: shutdowns, torques, rests, cooling, the rule for a load to go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.intervals import Interval
from openant_tools.robot.derating import Derating
from openant_tools.thermal.fit import Fit, Known, fit
from openant_tools.thermal.forecast import (
    HORIZON_S,
    HeatForecast,
    RestPlan,
    cool_down,
    derating,
    forecast,
    present_load,
    rest_advice,
    torque_load,
)  # fmt: skip
from openant_tools.thermal.inputs import Inputs

__all__ = ["Outlook", "outlook"]


@dataclass(frozen=True)
class Outlook:
    """What comes of a load.

    Attributes:
        found: what is known, and when of the run. from_cold: whether the load begins in the room's temperature.
        rules: under which it can go on. cooling: joint → s until it has cooled, of those that are to cool.
    """

    found: Fit
    told: HeatForecast
    rest: RestPlan
    rules: Derating
    cooling: Mapping[str, Interval]
    from_cold: bool

    @property
    def shuts_down(self) -> bool:
        """Whether a servo is more likely than not to."""
        return any(one.probability > 0.5 for one in self.told.joints)

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": "openant.thermal-forecast/1", "run": self.found.inputs.name, "load": self.told.load.words,
            "at_s": self.found.inputs.duration_s, "horizon_s": HORIZON_S, "from_cold": self.from_cold,
            "joints": [one.as_json() for one in self.told.joints], "rest": vars(self.rest),
            "derating": self.rules.as_table(),
            "cool_down_s": {joint: interval.as_json() for joint, interval in self.cooling.items()},
        }  # fmt: skip


def outlook(
    run: Inputs, *, after: Known | None = None, at_s: float | None = None, torque_nm: Mapping[str, float] | None = None,
    whole: bool = False, from_cold: bool = False,
) -> Outlook:  # fmt: skip
    """Look ahead from the end of a run's load.

    Args:
        after: what earlier runs taught. at_s: know only so much of the run, s.
        torque_nm: joint → torque that it is to hold instead. whole: take the mean load of the whole run.
        from_cold: begin in the room's temperature.

    Raises:
        BadInput: the run is shorter; no such joint.
    """
    if at_s is not None and at_s > run.duration_s + 1:
        words = f"the run ends after {number(run.duration_s / 60, 'min', decimals=1)}"
        raise BadInput(words, where=run.name, remedy="give --at less")
    known = run if at_s is None else run.until(at_s)
    found = fit([known], after=after)
    found = found if at_s is not None else found.at(run.loaded_s)
    load = torque_load(found, torque_nm) if torque_nm else present_load(found, whole=whole)
    told = forecast(found, load, from_cold=from_cold)
    cooling = {one.joint: cool_down(found, one.joint) for one in told.joints}
    return Outlook(
        found, told, rest_advice(found, load), derating(found, load, told=told),
        {joint: interval for joint, interval in cooling.items() if interval.value > 0}, from_cold,
    )  # fmt: skip
