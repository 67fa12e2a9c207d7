"""Registers that other software left: read, told, refused where a motion would be wrong; and joints that do not follow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builder import Robot, robot

from openant_tools.bringup.check import check
from openant_tools.calib.inventory import inventory
from openant_tools.calib.wires import engine_config
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.following import allowance
from openant_tools.comms.servos import Servo
from openant_tools.comms.state import differences, expected, in_words
from openant_tools.errors import HardwareFault
from openant_tools.procedure.finding import Finding, keep
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.robot.servo import servo_model

HOME = np.array(home_angles())
KNEE = Servo("knee_fl", 31, servo_model("XM430-W350-T"), 1, np.pi, 46)
FACTORY = {name: one.counts for name, one in expected(KNEE.model).items()}
LIMITS = {"knee_fl": (-1.22, 1.22)}


# ---- comparing: data in, words out -------------------------------------------------------------------------------------


def found(passport: dict[str, int] | None = None, **registers: int) -> list[tuple[str, bool]]:
    table = FACTORY | {"goal_pwm": registers.get("pwm_limit", 885), "goal_current": 1193} | registers
    wanted = {"knee_fl": expected(KNEE.model, passport=passport or {})}
    return [(one.register, one.stops) for one in differences([KNEE], {"knee_fl": table}, wanted, LIMITS)]


def test_a_servo_from_the_factory_differs_in_nothing():
    assert found() == found(operating_mode=4) == found(velocity_limit=350) == []


@pytest.mark.parametrize(
    "registers",
    [
        {"drive_mode": 1}, {"drive_mode": 4}, {"homing_offset": 500}, {"operating_mode": 16}, {"max_position_limit": 2200},
        {"min_position_limit": 1900}, {"profile_velocity": 1}, {"secondary_id": 21}, {"position_p_gain": 50},
    ],
)  # fmt: skip
def test_what_makes_a_motion_wrong_stops_it(registers):
    others = [replace(KNEE, joint="knee_fr", id=21)]
    table = {"knee_fl": FACTORY | {"goal_pwm": 885} | registers, "knee_fr": FACTORY}
    seen = differences([KNEE, *others], table, {one: expected(KNEE.model) for one in table}, LIMITS)
    assert [(one.joint, one.register, one.stops) for one in seen] == [("knee_fl", *registers, True)]
    assert f"(id 31): {next(iter(registers))} is {next(iter(registers.values()))}" in seen[0].what
    assert "`openant calib inventory`" in seen[0].mended


@pytest.mark.parametrize(
    "registers",
    [
        {"position_p_gain": 400}, {"feedforward_1st_gain": 100}, {"velocity_limit": 5}, {"moving_threshold": 50},
        {"secondary_id": 77}, {"shutdown": 0}, {"temperature_limit": 60}, {"startup_configuration": 1},
        {"goal_pwm": 100},  # raised whenever torque comes on
        {"profile_acceleration": 1},  # without a velocity there is no profile
        {"max_position_limit": 4000},  # beyond where this joint goes
        {"profile_velocity": 1000},  # faster than the servo can turn
        {"max_position_limit": 2200, "operating_mode": 4},  # not in force
    ],
)  # fmt: skip
def test_what_leaves_a_motion_right_is_told_and_stops_nothing(registers):
    assert found(**registers) == [(next(iter(registers)), False)]


def test_what_differs_alike_is_one_line():
    table = {name: FACTORY | {"position_p_gain": 400} for name in ("knee_fl", "knee_fr", "knee_rl")}
    servos = [replace(KNEE, joint=name, id=20 + k) for k, name in enumerate(table)]
    odd = differences(servos, table, {name: expected(KNEE.model) for name in table}, {})
    [line] = in_words(odd, remedy=False)
    assert line.startswith("3 servos: position_p_gain is 400,")
    assert in_words(odd[:1])[0] == str(odd[0])


def test_swapped_limits_stop():
    assert found(min_position_limit=4095, max_position_limit=0) == [
        ("min_position_limit", True), ("max_position_limit", True),
    ]  # fmt: skip


def test_the_passport_is_asked_before_the_factory():
    assert found({"position_p_gain": 400}, position_p_gain=400) == []
    [one] = differences(
        [KNEE],
        {"knee_fl": {"position_p_gain": 800}},
        {"knee_fl": expected(KNEE.model, passport={"position_p_gain": 400})},
    )
    assert "position_p_gain is 800, its passport has 400" in one.what


def test_power_does_not_mend_what_it_brings_back():
    table = {"knee_fl": {"profile_velocity": 1, "startup_configuration": 2}}
    told = differences([KNEE], table, {"knee_fl": expected(KNEE.model)}, LIMITS)
    assert "power off and on does not" in told[0].mended


def test_a_soft_servo_may_give_way_farther():
    assert allowance(KNEE, 800, 0.1) == 0.1
    assert 0.3 < allowance(KNEE, 100, 0.1) < 0.4


# ---- at the robot ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A healthy robot; each test leaves its registers as they were."""
    with robot(tmp_path_factory.mktemp("state") / "ant") as one:
        yield one


class left_behind:
    """Registers of knee_fl as other software left them, and as they were afterwards."""

    def __init__(self, ant: Robot, **registers: int) -> None:
        self.servo = ant.server.world.servos[ant.server.world.joints.index("knee_fl")]
        self.registers = registers

    def __enter__(self) -> None:
        self.before = {name: self.servo.get(name) for name in self.registers}
        for name, counts in self.registers.items():
            self.servo.set(name, counts)
        self.servo.settle()

    def __exit__(self, *error: object) -> None:
        for name, counts in self.before.items():
            self.servo.set(name, counts)
        self.servo.settle()


def test_nothing_moves_with_a_profile_or_limits_left_in_a_servo(ant: Robot, tmp_path: Path) -> None:
    with left_behind(ant, profile_velocity=1), EngineProcess(engine_config(ant.bench, imu=None)) as engine:
        with pytest.raises(HardwareFault, match=r"knee_fl \(id 31\): profile_velocity is 1, the factory's is 0"):
            engine.ask(messages.Torque(True))
        assert not any(ant.torque())
        # Other software may set it while we are connected, too: every start reads anew.
    with EngineProcess(engine_config(ant.bench, imu=None)) as engine:
        engine.ask(messages.Torque(True))
        with left_behind(ant, min_position_limit=1900, max_position_limit=2200):
            with pytest.raises(HardwareFault, match=r"min_position_limit is 1900.* 1 more such register"):
                engine.ask(messages.Record(str(tmp_path / "run"), Facts(JOINT_NAMES)))
            assert not (tmp_path / "run.mcap").exists()


def test_anyway_moves_and_the_recording_says_what_differed(ant: Robot, tmp_path: Path) -> None:
    config = replace(engine_config(ant.bench, imu=None), anyway=True)
    with left_behind(ant, min_position_limit=2040), EngineProcess(config) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))
        engine.ask(messages.Record(str(tmp_path / "run"), Facts(JOINT_NAMES)))
        engine.ask(messages.Hold(0.1))
        path, _ = engine.ask(messages.StopRecording())
        said = "\n".join(event.text for event in engine.events() if isinstance(event, messages.Notice))
    assert "knee_fl (id 31) stands " in said
    run = read_recording(path).run
    [fact] = run.facts.extra["differences"]
    assert (fact["joint"], fact["register"], fact["is"], fact["expected"]) == (
        "knee_fl",
        "min_position_limit",
        2040,
        0,
    )
    assert run.facts.extra["anyway"] is True
    assert run.facts.extra["behind_rad"]["knee_fl"] > 0.1
    assert run.facts.registers["knee_fl"]["min_position_limit"] == 2040


def test_a_joint_that_does_not_arrive_ends_the_motion(tmp_path: Path) -> None:
    stuck = [{"effect": "blocked_joint", "joints": ["knee_fl"], "parameters": {"angle_rad": -0.4}}]
    with robot(tmp_path / "ant", effect=stuck) as ant, EngineProcess(engine_config(ant.bench, imu=None)) as engine:
        engine.ask(messages.Torque(True))
        with pytest.raises(
            HardwareFault, match=r"knee_fl \(id 31\) stands −?\d+\.\d° from its command.*blocked, overloaded or weak"
        ):
            engine.ask(messages.Ramp(HOME))
        assert not any(ant.torque())


def test_a_register_that_changes_on_the_way_is_named_when_the_joint_does_not_arrive(ant: Robot) -> None:
    with EngineProcess(engine_config(ant.bench, imu=None)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(np.zeros(8)))
        with (
            left_behind(ant, min_position_limit=2040),
            pytest.raises(HardwareFault, match=r"stands −?\d+\.\d° .*; knee_fl \(id 31\): min_position_limit is 2040"),
        ):
            engine.ask(messages.Ramp(HOME))


def test_soft_rough_and_loaded_joints_are_let_go_on(tmp_path: Path) -> None:
    servos = [
        {"joint": "knee_fl", "position_p_gain": 100}, {"joint": "hip_fl", "position_p_gain": 100},
        {"joint": "knee_rr", "position_p_gain": 200, "feedforward_1st_gain": 50},
    ]  # fmt: skip
    effects = [
        {"effect": "coulomb_friction", "joints": ["hip_rr", "knee_rl"], "parameters": {"torque_nm": 0.15}},
        {"effect": "backlash", "joints": ["knee_fr"], "parameters": {"gap_rad": 0.05}},
        {"effect": "payload", "joints": "body", "parameters": {"mass_kg": 0.4}},
    ]
    with (
        robot(tmp_path / "ant", servo=servos, effect=effects, robot={"setup": "floor", "pose": "straight"}) as ant,
        EngineProcess(engine_config(ant.bench, imu=None)) as engine,
    ):
        told = [event.text for event in engine.events() if isinstance(event, messages.Notice)]
        assert any("knee_fl (id 31): position_p_gain is 100, the factory's is 800" in text for text in told)
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))
        engine.ask(messages.Hold(2.0))
        engine.ask(messages.Torque(False))


# ---- inventory and check ----------------------------------------------------------------------------------------------


def test_the_inventory_mends_ram_too_and_what_it_accepts_is_expected_from_then_on(tmp_path: Path) -> None:
    odd = [{"joint": "knee_fl", "profile_velocity": 1, "homing_offset": 300}]
    with robot(tmp_path / "ant", servo=odd) as ant:
        finding, builder = ant.do(
            inventory(ant.bench), ant.builder(answers={"What to do": "fix one by one", "homing_offset": "no"})
        )
        assert finding.ok
        assert "knee_fl: profile_velocity 1 → 0" in builder.granted
        assert ant.register("knee_fl", "profile_velocity") == 0
        assert finding.data["registers"]["knee_fl"]["homing_offset"] == 300
        keep(finding, ant.folder)
        with EngineProcess(engine_config(ant.bench, imu=None)) as engine:
            assert engine.description["differences"] == []
        # A second inventory does not take it back by itself.
        finding, builder = ant.do(inventory(ant.bench))
        assert "homing_offset is 300, the factory's is 0" in builder.said
        assert ant.register("knee_fl", "homing_offset") == 300


def test_the_check_names_the_register_before_it_blames_hardware(ant: Robot) -> None:
    sweep = {"friction_nm": 0.04, "friction_error_nm": 0.002, "weight_nm": 0.025, "weight_error_nm": 0.004,
             "low_stop_rad": None, "high_stop_rad": None, "lost": 0.0, "temperature_c": 27.0, "volts": 11.9}  # fmt: skip
    swept = {joint: {"joint": joint, **sweep} for joint in JOINT_NAMES}
    keep(Finding("bounds", True, "", (), "", "", data={"sweep": swept}), ant.folder)
    with left_behind(ant, drive_mode=1):
        finding, _ = ant.do(check(ant.bench))
    assert finding.ok is False
    assert [line.split(" → ")[0] for line in finding.problems] == [
        "knee_fl: drive_mode is 1, the factory's is 0: it turns the other way round"
    ]
    assert "cannot judge friction, weight and stops" in finding.unsure[0]
    assert "horn" not in "\n".join(finding.lines)
