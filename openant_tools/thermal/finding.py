"""What a soak comes to, as a finding for the passport and the walk."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.robot.config import Provenance, RobotConfig
from openant_tools.robot.derating import Derating
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.kit import Kit
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.robot.servo import ServoModel
from openant_tools.sysid.bench.knee_torque import knee_loads
from openant_tools.thermal.fit import Fit, HeldOut
from openant_tools.thermal.forecast import HeatForecast, RestPlan

__all__ = ["STEP", "keep_derating", "thermal_finding", "torque_warning", "warning_of"]

#: the walk's step
STEP = "thermal"
#: °C by which the later part of a soak may be missed before the model is not believed
BELIEVED_K = 2.0


def thermal_finding(
    found: Fit, told: HeatForecast, *, command: str, recording: str, held: HeldOut | None = None, rest: RestPlan | None = None,
    warning: str | None = None,
) -> Finding:  # fmt: skip
    """Evidence: where each servo goes, when it would shut down, what it can hold; yes where nothing shuts down.

    Args:
        recording: its path, relative to the robot's folder.
        told: from a cold start, so that it says the same of a robot whenever it was looked at.
        held: how the fit of the first part met the rest. rest: advice. warning: of the torque table.
    """
    evidence, problems = list[Evidence](), list[str]()
    source = f"two-node fit of {recording}"
    for one in told.joints:
        evidence.append(
            Evidence(
                f"{one.joint} settles at", one.settles_c.value, "°C", source, one.settles_c.low, one.settles_c.high
            )
        )
        if one.seconds_to_limit is not None:
            when = one.seconds_to_limit
            evidence.append(Evidence(f"{one.joint} to its limit", when.value, "s", source, when.low, when.high))
            remedy = rest.words if rest is not None else "rest in between, take off load, or put a heat sink on it"
            problems.append(f"{one.words} → {remedy}")
        if one.continuous_torque_nm is not None:
            torque = one.continuous_torque_nm
            evidence.append(
                Evidence(f"{one.joint} holds for ever", torque.value, "N·m", source, torque.low, torque.high)
            )
    glitches = {joint: int(n) for joint, n in zip(found.inputs.joints, found.inputs.glitches, strict=True) if n}
    if glitches:
        evidence.append(
            Evidence("telemetry errors", float(sum(glitches.values())), "1", "single readings no heat explains")
        )
    if held is not None:
        evidence.append(
            Evidence(
                "error on the later part", held.rms_k, "K", f"fit of the first {number(held.from_s, 's', decimals=0)}"
            )
        )
        if held.rms_k > BELIEVED_K:
            problems.append(
                f"the model misses the later part by {number(held.rms_k, 'K', decimals=1)}, most at {held.worst} → soak longer, in a still room"
            )
    if warning:
        problems.append(warning)
    first = told.first
    what = (
        f"under {told.load.words}, from cold, {first.words}"
        if first is not None
        else f"under {told.load.words} no servo comes to its limit"
    )
    parameters = tuple(
        Evidence(
            f"thermal.{e.joint}.{e.name}" if e.joint else f"thermal.{e.name}", e.value, e.unit, source, e.low, e.high
        )
        for e in found.estimates
        if e.name in ("case_j_k", "air_w_k", "winding_w_k") and e.informed > INFORMED
    )
    return Finding(
        STEP,
        first is None and not (held is not None and held.rms_k > BELIEVED_K),
        what,
        tuple(evidence),
        "" if first is None else (rest.words if rest is not None else "rest in between, or take off load"),
        command,
        parameters,
        {
            "recording": recording,
            "forecast": [one.as_json() for one in told.joints],
            "glitches": glitches,
            "held_out": None if held is None else asdict(held),
            "rest": None if rest is None else asdict(rest),
            "disturbance_k": found.disturbance_k,
        },
        problems=tuple(problems),
    )


#: share of the prior variance that a run must have taken away for a parameter to be called measured
INFORMED = 0.5


def torque_warning(
    knees: Sequence[tuple[str, ServoModel]],
    kit: Kit,
    *,
    supply_v: float,
    pwm_limit: float,
) -> str | None:
    """What the torque table says before anything is hot: None where every knee holds its stance.

    Of the stances of a gait, two legs at 45° (paper): what a walking robot bears all the time.
    """
    loads = knee_loads(knees, kit.total_mass_kg, (2,), (PAPER_ANGLE_RAD,), supply_v=supply_v, pwm_limit=pwm_limit)
    worst = max(loads, key=lambda load: load.torque_nm / load.nominal_nm)
    if worst.verdict == "holds":
        return None
    return (
        f"{worst.servo} knees bear {number(worst.torque_nm, 'N·m', decimals=2)} on two legs and hold {number(worst.nominal_nm, 'N·m', decimals=2)} for long: they "
        "will heat → walk with rests, or stand on four legs (`openant sysid torque` shows the table)"
    )


def warning_of(config: RobotConfig) -> str | None:
    """The same of a robot as its configuration describes it."""
    knees = [(motor.joint, motor.servo) for motor in config.motors.values() if motor.kind == "knee"]
    kit = kit_by_name(config.kit)
    return torque_warning(knees, kit, supply_v=kit.supply_v, pwm_limit=config.bus.pwm_limit)


def keep_derating(rules: Derating, folder: RobotFolder, run: Path, command: str) -> None:
    """Write the rules that a run gave into `robot.toml`, each with where it came from."""
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    source = Provenance("forecast", command, folder.relative(run), now)
    table = rules.as_table()
    values = {f"derating.{joint}.{key}": value for joint, rule in table.items() for key, value in rule.items()}
    folder.update(values, provenance={f"derating.{joint}": source for joint in table})


#: 45°, the paper's stance
PAPER_ANGLE_RAD = 0.785
