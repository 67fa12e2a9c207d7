"""The walk's step "thermal soak": a short soak, the fit, the forecast, the finding."""

from __future__ import annotations

import math
from collections.abc import Mapping

from openant_tools.calib.wires import engine_config
from openant_tools.numbers import number
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.step import Ask, Bench, Intent, Live, Procedure, Progress, Say
from openant_tools.recording.tables import read_run
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.thermal.finding import thermal_finding, torque_warning
from openant_tools.thermal.fit import fit_and_judge
from openant_tools.thermal.forecast import forecast, rest_advice
from openant_tools.thermal.inputs import inputs_of
from openant_tools.thermal.soak import Phase, SoakPlan, soak, soak_config

__all__ = ["thermal_soak"]

COMMAND = "openant calib thermal"
DEFAULT_MIN, SHORTEST_MIN, LONGEST_MIN = 10.0, 1.0, 240.0
#: reads a second
RATE_HZ = 5.0
#: share of the time under load that is kept of the cooling: it is what tells the case from the air
COOLING_SHARE = 0.3
#: what a phase of the soak is called while it lasts
PHASES: Mapping[Phase, str] = {"load": "holding the home pose", "cool-down": "cooling, torque off; Enter: enough of it"}
TEMPERATURES = "temperature of each servo, up to where it switches off"


def _minutes(minutes: float) -> str:
    """A time in words, in seconds where it is short."""
    return f"{number(minutes)} min" if minutes >= 2.0 else f"{number(60 * minutes, decimals=0)} s"


def thermal_soak(bench: Bench) -> Procedure:
    """Hold the home pose on the stand, keep every temperature, and say what heat will do to this robot."""
    config = bench.folder.config()
    kit = kit_by_name(config.kit)
    knees = [(motor.joint, motor.servo) for motor in config.motors.values() if motor.kind == "knee"]
    warning = torque_warning(knees, kit, supply_v=kit.supply_v, pwm_limit=config.bus.pwm_limit)
    if warning:
        yield Say(warning, "warn")
    minutes = yield Ask("Soak for how long?", unit="min", default=DEFAULT_MIN, low=SHORTEST_MIN, high=LONGEST_MIN)
    minutes = float(minutes) if isinstance(minutes, int | float) else DEFAULT_MIN
    cooling = COOLING_SHARE * minutes
    yield Intent(
        f"hold the home pose for {_minutes(minutes)}, then let go and record {_minutes(cooling)} of cooling", moves=True
    )
    path = bench.folder.recordings / "soak.mcap"
    path.unlink(missing_ok=True)
    plan = SoakPlan(load="hang", seconds=60 * minutes, cool_down_s=60 * cooling)
    engine = soak_config(engine_config(bench, imu=None), RATE_HZ)
    steps = soak(engine, plan, path, robot_toml=bench.folder.config_file.read_text(encoding="utf-8"))
    try:
        while True:
            sample = next(steps)
            if sample.words:
                yield Say(sample.words)
            known = {j: float(v) for j, v in zip(sample.joints, sample.temperature_c, strict=True) if math.isfinite(v)}
            limits = dict(zip(sample.joints, map(float, sample.limit_c), strict=True))
            yield Progress(sample.share, PHASES[sample.phase])
            enough = yield Live(known, "°C", TEMPERATURES, dict.fromkeys(known, 15.0), limits)
            if enough is True and sample.phase == "cool-down":
                break
    except StopIteration:
        pass
    finally:
        steps.close()
    run = inputs_of(read_run(path, need=()))
    # What is forecast is the load, not the cooling after it.
    whole, held = fit_and_judge([run])
    found = whole.at(run.loaded_s)
    told = forecast(found, from_cold=True)
    finding: Finding = thermal_finding(
        found, told, command=COMMAND, recording=bench.folder.relative(path), held=held, rest=rest_advice(found), warning=warning,
    )  # fmt: skip
    return finding
