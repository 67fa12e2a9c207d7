"""Heat as a builder meets it: soaks, telemetry errors, a crash, the fit, the forecast, what the servo's own limit does."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from builder import finished, robot
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from places import DATA

from openant_tools.cli import openant as manual
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.release import release_all
from openant_tools.comms.restart import MotionStopped
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.errors import BadInput, HardwareFault, OpenAntError
from openant_tools.procedure.finding import Finding, latest
from openant_tools.procedure.step import Answer, Ask, Event, Live, Progress, drive
from openant_tools.procedure.unfinished import unfinished
from openant_tools.recording.reader import read_recording
from openant_tools.recording.resume import continuation
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.recording.telemetry import Cycle, RecordedAnswer, ServoChannel
from openant_tools.recording.writer import RecordingWriter
from openant_tools.robot.derating import DeratedJoint, Derating, derating_of
from openant_tools.robot.kit import KITS
from openant_tools.robot.servo import servo_model
from openant_tools.thermal.compare import against_paper, compare
from openant_tools.thermal.finding import thermal_finding, torque_warning
from openant_tools.thermal.fit import Fit, Known, fit, held_out
from openant_tools.thermal.forecast import (
    HORIZON_S,
    cool_down,
    derating,
    forecast,
    present_load,
    rest_advice,
    torque_load,
)  # fmt: skip
from openant_tools.thermal.inputs import Inputs, inputs_of
from openant_tools.thermal.soak import SoakPlan, pose_angles, resume_plan, soak, soak_config
from openant_tools.thermal.step import thermal_soak
from openant_tools.thermal.thermometer import Thermometer, clean
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.world import World

DOZING = {"clock": {"mode": "stepped", "doze": True}}


# ---- a stalled robot without its mechanics: an hour of heat in a second ----


def stalled(kit: str = "lite", seconds: float = 3600.0, duty: float = 0.5, work_s: float = 1e9, **table: object) -> Run:
    """What the servos report while the knees press with `duty` for `work_s`, until one shuts down."""
    world = World(parse_scenario({"robot": {"kit": kit}, **table}).world)
    drives, rows, loads = world.drives, [], []
    knee = np.array([joint.startswith("knee") for joint in world.joints])
    limit = np.array([servo.model.temperature_limit_c for servo in world.servos])
    for t in range(int(seconds)):
        pressed = np.where(knee & (t < work_s), duty, 0.0)
        drives.duty, drives.voltage = pressed, drives.supply_v
        drives.current = pressed * drives.voltage / drives.resistance
        drives.heat(1.0)
        rows.append(np.floor(drives.case))
        loads.append((pressed, np.round(drives.current / 2.69e-3) * 2.69e-3))
        if (np.floor(drives.case) > limit).any():
            break
    columns = {}
    for k, (joint, servo) in enumerate(zip(world.joints, world.servos, strict=True)):
        columns[f"temp.{joint}"] = np.array([row[k] for row in rows])
        columns[f"pwm.{joint}"] = np.array([load[0][k] for load in loads])
        columns[f"volt.{joint}"] = np.full(len(rows), drives.supply_v)
        if servo.model.has_current_sensor:
            columns[f"cur.{joint}"] = np.array([load[1][k] for load in loads])
    motors = {joint: servo.model.name for joint, servo in zip(world.joints, world.servos, strict=True)}
    return Run(f"{kit} stalled", Facts(world.joints, motors=motors), np.arange(len(rows), dtype=float), columns)


def motor(**more: float) -> dict[str, object]:
    return {"motor": more}


@pytest.fixture(scope="module")
def stress() -> Run:
    """The Lite under the paper's stress test, until a knee shuts down."""
    return stalled(**motor(case_air_k_w=18.0))


@pytest.fixture(scope="module")
def lite(stress: Run) -> Inputs:
    return inputs_of(stress)


@pytest.fixture(scope="module")
def whole(lite: Inputs) -> Fit:
    """What all of that run tells."""
    return fit([lite])


# ---- thermometers ----


@settings(max_examples=60)
@given(
    st.lists(st.integers(0, 300), min_size=1, max_size=4, unique=True),
    st.floats(0.005, 0.1),
    st.integers(-60, 180).filter(lambda jump: abs(jump) > 12),
)
def test_single_wrong_readings_are_found_and_heat_is_left_alone(rows: list[int], rate: float, jump: int) -> None:
    t = np.arange(301.0)
    true = np.floor(25 + rate * t)
    rows = [row for k, row in enumerate(sorted(rows)) if k == 0 or row - sorted(rows)[k - 1] > 4]
    read = true.copy()
    read[rows] += jump
    cleaned = clean(t, read)
    assert cleaned.glitches.tolist() == rows
    assert np.nanmax(np.abs(cleaned.values - true)) == 0
    assert len(clean(t, true).glitches) == 0


def test_a_thermometer_that_watches_doubts_one_reading_and_believes_four() -> None:
    seen = Thermometer()
    for t, reading in enumerate([30, 30, 255, 31, 0, 31]):
        value = seen.read(float(t), reading)
    assert value == 31
    assert seen.glitches == 2
    for t in range(6, 10):
        value = seen.read(float(t), 60)
    assert value == 60, "what four readings in a row say is so"
    first = Thermometer()
    assert np.isnan(first.read(0.0, 200))
    assert np.isnan(first.read(0.2, 28))
    assert first.read(0.4, 28) == 28


# ---- the virtual robot's heat ----


def test_heat_sinks_help_metal_more_than_plastic() -> None:
    def settles(kit: str, **more: float) -> float:
        world = World(parse_scenario({"robot": {"kit": kit}, **motor(**more)}).world)
        for _ in range(7200):
            world.drives.current[:] = 0.5 if kit == "lite" else 0.9
            world.drives.heat(1.0)
        return float(world.drives.case[1])

    sink = {"heat_sink_k_w": 20.0, "heat_sink_j_k": 15.0}
    lite = settles("lite") - settles("lite", **sink)
    standard = settles("standard") - settles("standard", **sink)
    assert 0.5 < lite < 5.0
    assert standard > 2 * lite


def test_a_room_swings_and_a_leg_shares_its_warmth() -> None:
    world = World(parse_scenario({"room": {"ambient_c": 20.0, "swing_k": 5.0, "period_s": 40.0}}).world)
    world.doze = True
    world.advance(10.0)
    assert world.drives.ambient == pytest.approx(25.0, abs=0.1)
    assert world.drives.touching is not None
    assert world.drives.touching[0, 1] > 0
    assert world.drives.touching[0, 2] == 0
    with pytest.raises(BadInput, match="period_s = 0 → the time of one swing"):
        parse_scenario({"room": {"period_s": 0.0}})


def test_a_goal_that_is_in_force_wakes_nobody() -> None:
    world = World(parse_scenario({}).world)
    world.drives.set_goal(0, 0.0, 2000.0, 0.0, 0.0, False)
    world.advance(0.1)
    before = world.drives.touched
    world.drives.set_goal(0, 0.1, 2000.0, 0.0, 0.0, False)
    assert world.drives.touched == before
    world.drives.set_goal(0, 0.1, 2001.0, 0.0, 0.0, False)
    assert world.drives.touched == before + 1


# ---- the fit ----


def test_the_fit_knows_what_it_can_know(lite: Inputs, whole: Fit) -> None:
    found = whole
    for joint in ("knee_fl", "knee_rr"):
        seen = found.estimate("case_j_k", joint)
        assert seen.low < 48.0 < seen.high
        air = found.estimate("air_w_k", joint)
        assert air.low < 1 / 18.0 < air.high
        assert air.informed > 0.5
    assert found.estimate("gear").informed < 0.2, "nothing moved: the gear's share is what was believed"
    room = found.estimate("room_c")
    assert room.low < 25.0 < room.high
    assert np.nanmax(found.residual_k) < 0.3
    held = held_out(lite)
    assert held.rms_k < 1.5
    assert held.within > 0.9


def test_what_a_run_taught_is_believed_in_the_next(lite: Inputs, whole: Fit) -> None:
    short = lite.until(300.0)
    alone, taught = fit([short]), fit([short], after=whole.known)
    name = ("air_w_k", "knee_fl")
    width = [fitted.estimate(*name).high / fitted.estimate(*name).low for fitted in (alone, taught)]
    assert width[1] < 0.7 * width[0]
    again = Known.of_json(json.loads(json.dumps({"known": alone.known.as_json()})), "fit.json")
    assert again.names == alone.known.names
    assert np.allclose(again.covariance, alone.known.covariance)
    with pytest.raises(BadInput, match=r"fit\.json: this is no fit of heat"):
        Known.of_json({"known": {"joints": []}}, "fit.json")
    other = inputs_of(stalled("standard", seconds=120))
    with pytest.raises(BadInput, match="is of other servos than what is known"):
        fit([other], after=alone.known)


def test_current_and_duty_tell_the_same_heat() -> None:
    run = stalled("standard", seconds=900, duty=0.4)
    by_current = fit([inputs_of(run)])
    bare = dataclasses.replace(run, columns={n: c for n, c in run.columns.items() if not n.startswith("cur.")})
    by_duty = fit([inputs_of(bare)])
    assert by_current.inputs.source[1] == "current"
    assert by_duty.inputs.source[1] == "duty"
    a, b = (forecast(one, torques=False).joints[1].settles_c for one in (by_current, by_duty))
    assert abs(a.value - b.value) < 3.0


def test_a_run_without_temperatures_is_refused() -> None:
    run = stalled(seconds=60)
    cold = dataclasses.replace(run, columns={n: c for n, c in run.columns.items() if not n.startswith("temp.")})
    with pytest.raises(BadInput, match="the run has no temperatures → record one with `openant thermal soak`"):
        inputs_of(cold)


def test_half_an_hour_of_a_real_robot_foretells_its_hips() -> None:
    """facts/robot, section 9: hips keep their pose, so that what came after 1867 s can be forecast without a load."""
    run = read_run(DATA / "static_load.csv", need=())
    whole = inputs_of(run)
    found = fit([whole.until(1867.0)])
    told = forecast(found, horizon_s=3600.0, torques=False)
    inside = 0
    for k, joint in enumerate(whole.joints):
        if joint.startswith("knee"):
            settles = told.joints[k].settles_c
            assert settles.low < run.column(f"temp.{joint}")[3] < settles.high
            continue
        for when, seen in zip(run.t[4:], run.column(f"temp.{joint}")[4:], strict=True):
            row = int(np.argmin(np.abs(told.t - (when - 1867.0))))
            inside += told.fan[0.025][row, k] - 0.5 <= seen <= told.fan[0.975][row, k] + 0.5
    assert inside >= 11, "12 readings of four hips, later"
    assert told.joints[0].continuous_torque_nm is None, "nobody logged a load"
    with pytest.raises(BadInput, match="the load of knee_fl was not recorded"):
        torque_load(found, {"knee_fl": 0.5})


# ---- the forecast ----


def test_ten_minutes_foretell_the_shutdown(lite: Inputs) -> None:
    down = lite.duration_s
    assert 1200 < down < 2700, "the Lite's knee gives out after about half an hour"
    found = fit([lite.until(600.0)])
    told = forecast(found)
    first = told.first
    assert first is not None
    assert first.joint.startswith("knee")
    knees = [one for one in told.joints if one.joint.startswith("knee")]
    for one in knees:
        assert one.seconds_to_limit is not None
        assert one.seconds_to_limit.low < down - 600 < one.seconds_to_limit.high
        assert one.continuous_torque_nm is not None
        assert one.hour_torque_nm is not None
        assert one.continuous_torque_nm.low < one.continuous_torque_nm.value < one.hour_torque_nm.value * 1.1
    hip = told.joints[0]
    assert hip.seconds_to_limit is None
    assert "stays below 72 °C" in hip.words
    assert set(first.as_json()) >= {"joint", "temperature_c", "limit_c", "seconds_to_limit", "continuous_torque_nm"}
    easy = forecast(found, torque_load(found, dict.fromkeys([one.joint for one in knees], 0.2)), torques=False)
    assert easy.first is None
    rest = rest_advice(found)
    assert rest.work_s is not None
    assert 0 < rest.work_s < down
    assert 300 < rest.rest_s < HORIZON_S
    assert "rest" in rest.words


def test_derating_leaves_what_can_be_borne(lite: Inputs) -> None:
    found = fit([lite.until(900.0)])
    rules = derating(found)
    rule = rules.joints["knee_fl"]
    assert rule.stop_c == 70
    assert 0.4 < rule.least < 1.0
    load = present_load(found)
    derated = dataclasses.replace(load, current=load.current * rule.least**2, push=load.push * rule.least**2)
    assert forecast(found, derated, torques=False).joints[5].probability < 0.025
    assert rule.share(20) == 1.0
    assert rule.share(90) == rule.least
    assert rule.least < rule.share(66) < 1.0
    assert rule.share(float("nan")) == 1.0
    assert derating_of({"derating": rules.as_table()}) == Derating(
        {name: DeratedJoint(**table) for name, table in rules.as_table().items()}
    )
    assert rules.share({"hip_rr": 79.0, "knee_fl": 90.0}) == {"hip_rr": 1.0, "knee_fl": rule.least}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (3, "derating is not a table"),
        ({"knee_fl": {"start_c": 60}}, "needs start_c, stop_c and least"),
        ({"knee_fl": {"start_c": 60, "stop_c": 50, "least": 0.5}}, "start_c is below stop_c"),
        ({"knee_fl": {"start_c": "a", "stop_c": 50, "least": 0.5}}, "are numbers"),
    ],
)
def test_rules_that_cannot_be_name_their_place(table: object, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        derating_of({"derating": table})
    assert derating_of({}) is None


def test_after_a_shutdown_nobody_hurries(whole: Fit) -> None:
    knee = cool_down(whole, "knee_fl")
    assert knee.low >= 1200.0, "the maker's twenty minutes"
    assert cool_down(whole, "hip_fl").value == 0.0


def test_sinks_and_the_paper_are_compared(whole: Fit) -> None:
    finned = inputs_of(stalled(seconds=1800, **motor(case_air_k_w=8.0, case_j_k=60.0)))
    with_sinks = fit([finned])
    differences = {one.joint: one for one in compare(whole, with_sinks)}
    knee = differences["knee_fl"]
    assert knee.certain
    assert knee.difference_k.high < 0
    same = compare(whole, whole, joints={"knee_fl": "knee_fr"})[0]
    assert not same.certain
    assert same.joint == "knee_fl / knee_fr"
    beside = against_paper(whole)
    assert "as the paper's, within the interval" in beside.words
    assert beside.later_s is not None
    assert beside.later_s.low < 0 < beside.later_s.high
    with pytest.raises(BadInput, match="has no joint 'knee'"):
        compare(whole, with_sinks, joints={"knee": "knee"})


def test_a_finding_says_it_all_and_the_table_warns_while_cold(lite: Inputs, whole: Fit) -> None:
    found = whole
    warning = torque_warning([("knee_fl", servo_model("XL430-W250-T"))], KITS["lite"], supply_v=11.1, pwm_limit=0.5)
    assert warning is not None
    assert "0.54 N·m on two legs and hold 0.28 N·m" in warning
    standard = [("knee_fl", servo_model("XM430-W350-T"))]
    assert torque_warning(standard, KITS["standard"], supply_v=12.0, pwm_limit=0.5) is None
    finding = thermal_finding(
        found, forecast(found, from_cold=True), command="test", recording="soak.mcap", held=held_out(lite),
        rest=rest_advice(found), warning=warning,
    )  # fmt: skip
    assert not finding.ok
    assert "reaches 72 °C" in finding.what
    assert warning in finding.problems
    assert any(parameter.name == "thermal.knee_fl.case_j_k" for parameter in finding.parameters)
    start = next(one for one in found.estimates if one.name == "start_k")
    assert (start.unit, start.value) == ("°C", pytest.approx(lite.observed[0].temperature[0], abs=2)), "a temperature"
    assert Finding.of_json(json.loads(json.dumps(finding.as_json()))).what == finding.what


# ---- soaks through the real driver ----


def run_soak(plan: SoakPlan, out: Path, robot_: object, *, resume: bool = False, rate_hz: float = 4.0):  # type: ignore[no-untyped-def]
    bench = robot_.bench  # type: ignore[attr-defined]
    config = soak_config(config_of_unknown_robot(bench.bus, bench.control), rate_hz, plan.margin_k)
    return soak(config, plan, out, resume=resume)


def test_a_soak_survives_kill_9_and_is_one_recording(tmp_path: Path) -> None:
    out = tmp_path / "soak.mcap"
    plan = SoakPlan(load="hang", seconds=90.0, cool_down_s=30.0, poses=("home", "knee=-0.5"), heat_sinks=("knee_fl",))
    glitch = {"cause": "temperature_glitch", "where": "knee_rr", "fraction": 0.02}
    with robot(tmp_path / "ant", fault=[glitch], **DOZING) as there:
        steps = run_soak(plan, out, there)
        assert any(isinstance(event, Progress) and (event.share or 0) >= 40 / 120 for event in steps)
        [engine] = [one for one in EngineProcess.running if one.config.port == there.bench.bus]
        # Stepped time runs faster than the disk is synced, once a second.
        for _ in range(600):
            if out.stat().st_size > 10_000 + 5_000:
                break
            time.sleep(0.05)
        os.kill(engine.pid, signal.SIGKILL)
        with pytest.raises(HardwareFault, match="the engine has ended"):
            finished(steps)
        torn = read_recording(out)
        assert torn.damage is not None
        assert resume_plan(out) == plan
        for _ in range(300):  # its guardian holds the port until torque is off
            try:
                again = run_soak(resume_plan(out), out, there, resume=True)
                break
            except HardwareFault:
                time.sleep(0.1)
        made = finished(again)
        assert not any(there.torque())
    assert made.why == "time"
    assert made.loaded_s == pytest.approx(90.0, abs=3.0)
    recording = read_recording(out)
    run = recording.run
    assert recording.damage is None
    assert (np.diff(run.t) > 0).all()
    assert len(run.t) >= len(torn.run.t) + 100
    assert (run.t[: len(torn.run.t)] == torn.run.t).all()
    assert [event["kind"] for event in recording.events] == ["resumed"]
    torque = run.signal("torque").max(axis=1)
    assert torque[0] == 1
    assert torque[-1] == 0, "the cooling is in it"
    inputs = inputs_of(run)
    assert inputs.glitches[inputs.joints.index("knee_rr")] >= 1
    assert inputs.heat_sinks == ("knee_fl",)
    assert made.peak_c["knee_rr"] < 40, "a telemetry error is no peak"
    assert list(tmp_path.glob(".soak*")) == []


def test_a_soak_ends_below_the_limit_that_the_servo_has(tmp_path: Path) -> None:
    servo = {"joint": "hip_fl", "temperature_limit": 40}
    with robot(
        tmp_path / "ant", servo=[servo], room={"ambient_c": 29.0}, **DOZING, **motor(case_j_k=4.0, standby_a=0.1)
    ) as there:
        made = finished(run_soak(SoakPlan(load="hang", seconds=600.0, cool_down_s=5.0), tmp_path / "soak.mcap", there))
    assert made.why == "margin"
    assert made.joint == "hip_fl"
    assert made.loaded_s < 300
    assert "37 °C, 3 K below its limit" in made.words


def test_enough_ends_the_cooling_and_not_the_load(tmp_path: Path) -> None:
    class Impatient:
        """Says "enough" whenever it may."""

        def answer(self, event: Event) -> Answer:
            return True if isinstance(event, Live) else None

    with robot(tmp_path / "ant", **DOZING) as there:
        plan = SoakPlan(load="hang", seconds=60.0, cool_down_s=600.0)
        made = drive(run_soak(plan, tmp_path / "soak.mcap", there), Impatient())
        assert not any(there.torque())
    assert (made.why, made.loaded_s) == ("time", pytest.approx(60.0, abs=1.0))
    recording = read_recording(tmp_path / "soak.mcap")
    assert 65.0 < recording.run.duration_s < 90.0
    assert recording.events == ()
    assert recording.damage is None


def test_the_engine_stops_a_hot_robot_that_nobody_watches(tmp_path: Path) -> None:
    """Half way between the margin and the servo's own limit, and not for one wrong answer."""
    servo = {"joint": "hip_fl", "temperature_limit": 40}
    glitch = {"cause": "temperature_glitch", "where": "knee_rr", "fraction": 0.05}
    with robot(
        tmp_path / "ant", servo=[servo], fault=[glitch], room={"ambient_c": 29.6}, **DOZING,
        **motor(case_j_k=4.0, standby_a=0.1),
    ) as there:  # fmt: skip
        config = soak_config(config_of_unknown_robot(there.bench.bus, there.bench.control), 4.0, 4.0)
        with EngineProcess(config) as engine:
            engine.ask(messages.Torque(True))
            with pytest.raises(HardwareFault, match=r"hip_fl .* is at 38 °C, 40 °C is its limit"):
                engine.ask(messages.Hold(600.0))
            assert not any(there.torque())


def test_a_hot_robot_is_left_to_cool(tmp_path: Path) -> None:
    fault = {"cause": "overheated", "where": "knee_rr", "temperature_c": 75.0}
    with robot(tmp_path / "ant", fault=[fault], **DOZING) as there:
        with pytest.raises(
            HardwareFault, match=r"knee_rr is at 7\d °C, 80 °C is its limit.* → let it cool below 70 °C"
        ):
            finished(run_soak(SoakPlan(load="hang", seconds=60.0), tmp_path / "soak.mcap", there))
        assert not any(there.torque())
        assert not (tmp_path / "soak.mcap").exists()


def test_knees_that_move_are_not_stalled(tmp_path: Path) -> None:
    with robot(tmp_path / "ant", **DOZING) as there:
        with pytest.raises(BadInput, match=r"knee_\w\w is not stalled: it presses with .* → let the robot lie"):
            finished(run_soak(SoakPlan(load="stall", seconds=60.0), tmp_path / "soak.mcap", there))
        assert not any(there.torque())
        assert not (tmp_path / "soak.mcap").exists()


def test_a_stalled_robot_presses_until_a_servo_shuts_down(tmp_path: Path) -> None:
    weight = {"effect": "payload", "joints": "body", "parameters": {"mass_kg": 8.0, "position_m": [0, 0, 0.05]}}
    table = {
        "robot": {"kit": "lite", "setup": "floor"},
        "effect": [weight],
        **DOZING,
        # Warm enough to pass its limit with a slope: in the balance there, 73 °C could last less than the time between two rows.
        **motor(case_j_k=6.0, winding_j_k=2.0, case_air_k_w=18.0),
    }
    with robot(tmp_path / "ant", kit="lite", **table) as there:
        plan = SoakPlan(load="stall", seconds=900.0, cool_down_s=20.0, margin_k=-1.0)
        made = finished(run_soak(plan, tmp_path / "stress.mcap", there))
    assert made.why == "shutdown"
    assert made.joint is not None
    assert made.joint.startswith("knee")
    assert "its limit is 72 °C" in made.words
    assert made.peak_c[made.joint] == 73
    duty = read_run(tmp_path / "stress.mcap", need=()).column("pwm.knee_fl")[10:]
    assert np.abs(duty[np.isfinite(duty)][0]) == pytest.approx(0.5, abs=0.02)


def test_the_walks_step_soaks_fits_and_finds(tmp_path: Path) -> None:
    with robot(tmp_path / "ant", **DOZING) as there:
        finding, builder = there.do(thermal_soak(there.bench), there.builder(answers={"how long": 2.0}))
        assert not any(there.torque())
    assert finding.step == "thermal"
    assert finding.ok, finding.problems
    assert any(one.name == "knee_fl holds for ever" for one in finding.evidence)
    assert "hold the home pose for 2 min" in builder.said
    seen = [event.marks for event in builder.events if isinstance(event, Live) and event.marks][-1]
    assert re.search(r"(?<!load )[+−]\d\.\d\d A, \d+\.\d V$", seen["knee_fl"]), "a servo that measures its current"
    assert re.search(r"load [+−]\d+ %, \d+\.\d V$", seen["hip_fl"]), "one that does not"
    (recording,) = (tmp_path / "ant" / "recordings").iterdir()
    assert finding.data["recording"] == f"recordings/{recording.name}"


def test_a_soak_that_was_stopped_goes_on_with_its_next_minute(tmp_path: Path) -> None:
    """By the stop key under load, then by leaving while it cools: each time what was soaked counts, and nobody is asked again."""

    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.words.startswith("holding") and (event.share or 0) > 0.4:
            release_all()

    def leave(event: Event) -> None:
        if isinstance(event, Progress) and event.words.startswith("cooling") and (event.share or 0) > 0.9:
            raise KeyboardInterrupt

    def torque_on_s() -> float:
        (soak,) = (tmp_path / "ant" / "recordings").iterdir()  # gone on with, it is one
        run = read_recording(soak).run
        step = np.diff(run.t, append=run.t[-1])
        return float(step[(run.signal("torque").max(axis=1) > 0) & (step < 5)].sum())

    with robot(tmp_path / "ant", **DOZING) as there:
        with pytest.raises(MotionStopped):
            there.do(thermal_soak(there.bench), there.builder(answers={"how long": 3.0}, before=stop))
        assert not any(there.torque())
        left = unfinished(there.folder, "thermal", virtual=True)
        assert left is not None
        assert (left.words, left.next) == ("1 of 4", "minute 2")
        assert torque_on_s() < 150
        builder = there.builder(before=leave)
        with pytest.raises(KeyboardInterrupt):
            there.do(thermal_soak(there.bench), builder)
        assert "it goes on at 2 of 4: minute 1 was done before" in builder.said
        assert not [event for event in builder.events if isinstance(event, Ask)]
        assert torque_on_s() == pytest.approx(180, abs=3)
        left = unfinished(there.folder, "thermal", virtual=True)
        assert left is not None
        assert left.next == "minute 4"
        finding, builder = there.do(thermal_soak(there.bench))
        assert "holding the home pose" not in builder.said
    assert finding.ok, finding.problems
    assert torque_on_s() == pytest.approx(180, abs=3)
    assert unfinished(there.folder, "thermal", virtual=True) is None


# ---- gone on with ----


def channel(joint: str, zero: float = 0.0) -> ServoChannel:
    return ServoChannel(joint, "XL430-W250-T", 11, 1, zero, {"pos": 0.0015, "temp": 1.0})


def record(path: Path, start: float, rows: int, **more: object) -> None:
    with RecordingWriter(
        path, facts=Facts(("knee_fl",)), channels=[channel("knee_fl")], clock=lambda: start, **more
    ) as writer:  # type: ignore[arg-type]
        for k in range(rows):
            answer = RecordedAnswer({"pos": k, "temp": 30}, True)
            writer.cycle(Cycle(start + 0.1 * k, [None], None, None, [answer], [True]))


def test_a_clock_that_began_anew_goes_on_after_the_pause(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, 5000.0, 20)
    again = continuation(path, [channel("knee_fl")], 3.0, wall_counts=True)
    assert 5020.0 > 3.0 + again.shift_s > 5001.9, "the wall clock says that only a moment has passed"
    stepped = continuation(path, [channel("knee_fl")], 3.0, wall_counts=False)
    assert stepped.shift_s + 3.0 == pytest.approx(stepped.last_s + 1.0)
    record(path, 3.0, 20, continued=stepped)
    run = read_recording(path).run
    assert len(run.t) == 40
    assert (np.diff(run.t) > 0).all()
    assert run.t[20] == pytest.approx(stepped.last_s + 1.0)
    with pytest.raises(BadInput, match=r"other servos, or of others mounted .knee_fl differ"):
        continuation(path, [channel("knee_fl", zero=0.1)], 3.0, wall_counts=False)
    with pytest.raises(BadInput, match="there is no recording to go on with"):
        continuation(tmp_path / "none.mcap", [], 0.0, wall_counts=True)


# ---- the command line ----


def command(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(manual, [str(word) for word in words], standalone_mode=False)
    if isinstance(done.exception, OpenAntError):
        return done.exception.exit_code, str(done.exception)
    if done.exception is not None:
        raise done.exception
    return int(done.return_value or 0), done.output


def test_fit_forecast_and_compare_from_tables(tmp_path: Path, stress: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("openant_tools.thermal.compare.DRAWS", 200)
    bare = stress
    write_table(bare, tmp_path / "bare.parquet")
    write_table(stalled(seconds=1000, **motor(case_air_k_w=12.0)), tmp_path / "cool.csv")
    assert command("config", "new", "--kit", "lite", "--robot", tmp_path / "ant")[0] == 0
    code, out = command("thermal", "fit", tmp_path / "bare.parquet", "--json", tmp_path / "fit.json", "--robot", tmp_path / "ant",
                        "--report", tmp_path / "report")  # fmt: skip
    assert code == 0
    assert "inside the 95 % band" in out
    assert (tmp_path / "report" / "report.html").is_file()
    from openant_tools.robot.folder import RobotFolder

    kept = latest(RobotFolder.at(tmp_path / "ant"), "thermal")
    assert kept is not None
    assert not kept.ok
    code, out = command(
        "thermal", "forecast", tmp_path / "bare.parquet", "--at", 10, "--json", tmp_path / "told.json", "--derate",
        "--robot", tmp_path / "ant", "--after", tmp_path / "fit.json", "--report", tmp_path / "ahead",
    )  # fmt: skip
    assert code == 1
    assert (tmp_path / "ahead" / "report.html").is_file()
    assert "reaches 72 °C after" in out
    assert "advice: work" in out
    assert "walk with rests" in out
    told = json.loads((tmp_path / "told.json").read_text())
    knee = next(one for one in told["joints"] if one["joint"] == "knee_fl")
    assert knee["seconds_to_limit"]["low"] < bare.duration_s - 600 < knee["seconds_to_limit"]["high"]
    written = tomllib.loads((tmp_path / "ant" / "robot.toml").read_text())
    rules = derating_of(written)
    assert rules is not None
    assert 0 < rules.joints["knee_fl"].least < 1
    assert command("config", "check", "--robot", tmp_path / "ant")[0] == 0
    written_to = ("--json", tmp_path / "diff.json", "--report", tmp_path / "diff")
    code, out = command("thermal", "compare", tmp_path / "bare", tmp_path / "cool", *written_to)
    assert code == 0
    assert "knee_fl" in out
    assert " *" in out
    assert (tmp_path / "diff" / "report.html").is_file()
    written_to = ("--json", tmp_path / "paper.json", "--report", tmp_path / "paper")
    code, out = command("thermal", "compare", tmp_path / "bare", "--paper", *written_to)
    assert code == 0
    assert out.startswith("Paper: a Lite's knee")
    assert json.loads((tmp_path / "paper.json").read_text())["paper"] == out.splitlines()[0]
    assert out.splitlines()[0] in (tmp_path / "paper" / "report.md").read_text()


def test_a_trained_policy_is_a_load(tmp_path: Path) -> None:
    """It walks in the simulation; what it commanded stands beside the recording, so that --resume finds it."""
    pytest.importorskip("torch")
    import gymnasium

    import openant_env  # noqa: F401  (registers the environments)
    from openant_agents.sac import SacSettings, train

    env = gymnasium.make("openant/Ant-v0", kit="lite")
    facts = {"id": "openant/Ant-v0", "options": {"kit": "lite"}}
    small = SacSettings(learning_start=60, batch=16, hidden=16)
    train(env, folder=tmp_path / "policy", steps=30, seed=0, settings=small, env_facts=facts)
    out = tmp_path / "walked.mcap"
    code, said = command(
        "thermal", "soak", "--virtual", "--play", tmp_path / "policy", "--minutes", 0.05, "--cool-down", 0, "--rate", 25,
        "--out", out, "--yes",
    )  # fmt: skip
    assert code == 0, said
    played = read_run(tmp_path / "walked-policy.parquet", need=("cmd",))
    assert played.duration_s == pytest.approx(60.0, abs=0.3)
    walked = read_run(out, need=())
    assert 2.9 < walked.duration_s < 8.0, "three seconds, and lying down"
    seen, asked = walked.column("cmd.knee_fl"), played.column("cmd.knee_fl")[5:20]
    assert all(np.abs(seen - angle).min() < 2e-3 for angle in asked)
    assert resume_plan(out).commands == str(tmp_path / "walked-policy.parquet")
    code, said = command("thermal", "soak", "--virtual", "--play", tmp_path, "--out", tmp_path / "no.mcap", "--yes")
    assert code == 2
    assert "there is no training run here" in said


def test_mistakes_on_the_command_line_are_named(tmp_path: Path) -> None:
    write_table(stalled(seconds=120), tmp_path / "run.parquet")
    (tmp_path / "bad.json").write_text("{}")
    (tmp_path / "soak.mcap").write_text("")
    run = tmp_path / "run"
    for words, message in (
        (("forecast", run, "--at", 10), "the run ends after 2.0 min → give --at less"),
        (("forecast", run, "--load", "knee_fl"), "'knee_fl' is no load → write --load knee_fl=0.6"),
        (("forecast", run, "--load", "knee=1"), "the run has no joint 'knee'"),
        (("forecast", run, "--derate"), "no robot to write the rule to"),
        (("forecast", run, "--after", tmp_path / "bad.json"), "this is no fit of heat"),
        (("compare", run), "name two soaks, or one and --paper"),
        (("soak", "--out", tmp_path / "soak.mcap", "--virtual"), "there is a recording already"),
        (("soak", "--out", tmp_path / "new.mcap", "--resume"), "there is no soak to go on with"),
        (("soak", "--out", tmp_path / "new.mcap", "--pose", "handstand"), "'handstand' is no pose"),
        (("soak", "--out", tmp_path / "new.mcap", "--heat-sink", "elbow"), "no joint 'elbow'"),
        (("soak", "--out", tmp_path / "new.parquet", "--virtual"), "a recording is a .mcap file"),
    ):
        code, out = command("thermal", *words)
        assert code == 2, out
        assert message in out
    record(tmp_path / "other.mcap", 0.0, 5)
    with pytest.raises(BadInput, match="no recording of a soak"):
        resume_plan(tmp_path / "other.mcap")
    assert pose_angles("knee=-0.3", ("hip_rr", "knee_rr")).tolist() == [0.0, -0.3]
