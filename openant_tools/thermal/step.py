"""The walk's step "thermal soak": a short soak, the fit, the forecast, the finding."""

from __future__ import annotations

from pathlib import Path

from openant_tools.calib.wires import engine_config
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.by_time import minutes, noted
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.step import Ask, Bench, Intent, Procedure, Say
from openant_tools.procedure.unfinished import Parts, forget, unfinished
from openant_tools.recording.tables import read_run
from openant_tools.thermal.finding import thermal_finding, warning_of
from openant_tools.thermal.fit import fit_and_judge
from openant_tools.thermal.forecast import forecast, rest_advice
from openant_tools.thermal.inputs import inputs_of
from openant_tools.thermal.soak import SoakPlan, resume_plan, soak, soak_config

__all__ = ["thermal_soak"]

COMMAND = "openant calib thermal"
DEFAULT_MIN, SHORTEST_MIN, LONGEST_MIN = 10.0, 1.0, 240.0
#: reads a second
RATE_HZ = 5.0
#: share of the time under load that is kept of the cooling: it is what tells the case from the air
COOLING_SHARE = 0.3


def _minutes(seconds: float) -> str:
    """A time in words, in seconds where it is short."""
    return number(seconds / 60, "min") if seconds >= 120 else number(seconds, "s", decimals=0)


def thermal_soak(bench: Bench) -> Procedure:
    """Hold the home pose on the stand, keep every temperature, and say what heat will do to this robot."""
    warning = warning_of(bench.folder.config())
    if warning:
        yield Say(warning, "warn")
    left = _left(bench)
    resume = left is not None
    if left is not None:
        path, plan = left
    else:
        forget(bench.folder, "thermal", virtual=bench.virtual)  # nothing of it is there any more
        path = bench.folder.new_recording("soak")
        asked = yield Ask("Soak for how long?", unit="min", default=DEFAULT_MIN, low=SHORTEST_MIN, high=LONGEST_MIN)
        length = float(asked) if isinstance(asked, int | float) else DEFAULT_MIN
        plan = SoakPlan(load="hang", seconds=60 * length, cool_down_s=60 * COOLING_SHARE * length)
    parts = Parts(bench, "thermal", minutes(plan.seconds + plan.cool_down_s))
    if resume:
        yield Say(parts.words)
    yield Intent(
        f"hold the home pose for {_minutes(plan.seconds)}, then let go and record {_minutes(plan.cool_down_s)} of cooling"
        + (", what was left of it" if resume else ""),
        moves=True,
    )
    engine = soak_config(engine_config(bench, imu=None), RATE_HZ)
    text = bench.folder.config_file.read_text(encoding="utf-8")
    soaking = soak(engine, plan, path, robot_toml=text, resume=resume)
    yield from noted(soaking, parts, recording=bench.folder.relative(path))
    parts.end()
    run = inputs_of(read_run(path, need=()))
    # What is forecast is the load, not the cooling after it.
    whole, held = fit_and_judge([run])
    found = whole.at(run.loaded_s)
    told = forecast(found, from_cold=True)
    finding: Finding = thermal_finding(
        found, told, command=COMMAND, recording=bench.folder.relative(path), held=held, rest=rest_advice(found), warning=warning,
    )  # fmt: skip
    return finding


def _left(bench: Bench) -> tuple[Path, SoakPlan] | None:
    """Recording and plan of the soak that was left in the middle; None where there is none, or none of its recording."""
    left = unfinished(bench.folder, "thermal", virtual=bench.virtual)
    if left is None or (path := left.recording(bench.folder)) is None:
        return None
    try:
        plan = resume_plan(path)
    except BadInput:
        return None
    return (path, plan) if left.of == minutes(plan.seconds + plan.cool_down_s) else None
