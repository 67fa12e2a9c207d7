"""The bench work of the paper: knee torque, stiffness by kitchen scale, floor friction by tilted plate."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from builder import COARSE, Builder
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.cli import main
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.messages import ImuConfig
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.errors import BadInput
from openant_tools.procedure.step import Answer, Ask, Event, Hands, drive
from openant_tools.robot.folder import create_robot
from openant_tools.robot.kit import kit
from openant_tools.robot.servo import servo_model
from openant_tools.sysid.bench.friction import onset_angle, up_direction
from openant_tools.sysid.bench.knee_torque import GRAVITY_M_S2, KNEE_TO_GROUND_M, knee_load, knee_torque
from openant_tools.sysid.bench.scale import Pressing, stiffness
from openant_tools.sysid.bench.stiffness import DutyReading, Lever, fit_line, servo_line
from openant_tools.sysid.bench.tilt import floor_friction
from openant_tools.virtual.process import virtual_robot


def openant(*words: object) -> int:
    """Run a command line in this process; its exit code."""
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


# ---- knee torque ----


@pytest.mark.parametrize(("name", "said"), [("standard", 0.66), ("lite", 0.54)])
def test_the_papers_knee_torques(name: str, said: float) -> None:
    assert knee_torque(kit(name).total_mass_kg, 2, math.radians(45)) == pytest.approx(said, abs=0.005)


def test_the_torque_table_warns_of_the_lites_knees_and_not_of_the_standards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "torque.json"
    assert openant("sysid", "torque", "--kit", "standard") == 0
    assert "knees hold" in capsys.readouterr().out
    assert openant("sysid", "torque", "--kit", "lite", "--json", file) == 1
    out = capsys.readouterr().out
    assert "0.54 N·m against a nominal 0.28 N·m" in out
    content = json.loads(file.read_text())
    assert content["ok"] is False
    assert content["next_action"]
    # An XL430 at half its PWM: 1.4 N·m · 0.5.
    assert [row["limit_nm"] for row in content["data"]["rows"]] == pytest.approx([0.7] * 6)


def test_a_robots_own_mass_pose_and_limits_enter_and_the_finding_is_kept(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "ant", "standard", values={"bus.pwm_limit": 0.25})
    assert openant("sysid", "torque", "--robot", folder.path, "--mass", "3.9", "--legs", 2, "--angle", "45deg") == 1
    (file,) = folder.findings.glob("*.json")
    finding = json.loads(file.read_text())
    assert finding["data"]["rows"][0]["verdict"] == "gives way"
    assert finding["data"]["rows"][0]["limit_nm"] == pytest.approx(4.1 * 0.25)
    assert all(entry["unit"] and entry["source"] for entry in finding["evidence"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--angle", "45"], "write 45deg"),
        (["--legs", "5"], "1 to 4"),
        (["--mass", "-1"], "mass"),
        (["--servo", "XL430-W25"], "XL430-W250-T"),
        (["--supply", "24"], "does not run on 24 V"),
        (["--pwm-limit", "50"], "50.0 is not in the range 0.0<x<=1.0"),
        (["--angle", "steep"], "is no angle"),
    ],
)
def test_what_cannot_be_asked_of_the_table_is_said(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert openant("sysid", "torque", "--kit", "standard", *words) == 2
    assert message in capsys.readouterr().err


def test_more_supply_gives_more_stall_torque_and_no_more_of_the_nominal() -> None:
    servo = servo_model("XM430-W350-T")
    low, high = (knee_load("knee_fl", servo, 1.2, 2, 0.8, supply_v=v, pwm_limit=0.5) for v in (11.1, 12.0))
    assert (low.limit_nm, high.limit_nm) == pytest.approx((3.8 / 2, 4.1 / 2))  # the data sheet's at 11.1 and 12 V
    assert low.nominal_nm == high.nominal_nm


# ---- stiffness by kitchen scale ----

SHEET_STIFFNESS = 18.88  # N·m/rad: XM430-W350, P 800, divisor 128, 12 V


def grams_of(
    stiffness: float, deflection: float, length: float = KNEE_TO_GROUND_M, knee: float = math.radians(-50)
) -> float:
    return stiffness * deflection / (GRAVITY_M_S2 * length * math.cos(knee)) * 1e3


def notes(path: Path, stiffness: float, deflections: list[float], scatter: float = 0.0) -> Path:
    rng = np.random.default_rng(0)
    lines = [f"{d},{grams_of(stiffness, d) + scatter * rng.standard_normal():.1f}" for d in deflections]
    path.write_text("deflection,grams\n" + "\n".join(lines) + "\n")
    return path


STEPS = [0.0, 0.02, 0.04, 0.06, 0.08]


def test_typed_grams_give_stiffness_with_interval_and_the_divisor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "out.json"
    notebook = notes(tmp_path / "grams.csv", 18.638, STEPS, scatter=10.0)  # the paper's XM430
    assert openant("sysid", "scale", "--readings", notebook, "--json", file) == 0
    assert "the P divisor is 128" in capsys.readouterr().out
    value = json.loads(file.read_text())["parameters"]["scale_stiffness.knee_fl"]
    assert value["low"] < 18.638 < value["high"]
    assert value["value"] == pytest.approx(18.638, rel=0.05)


def test_half_the_stiffness_is_the_divisor_that_bam_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    notebook = notes(tmp_path / "grams.csv", SHEET_STIFFNESS / 2, STEPS)
    assert openant("sysid", "scale", "--readings", notebook) == 0
    assert "the P divisor is 256" in capsys.readouterr().out


def test_the_papers_xl430_stiffness_fits_no_divisor_and_is_doubted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notebook = notes(tmp_path / "grams.csv", 19.499, [0.0, 0.01, 0.02, 0.03])
    assert openant("sysid", "scale", "--readings", notebook, "--servo", "XL430-W250-T") == 1
    out = capsys.readouterr().out
    assert "support neither known P divisor" in out
    assert "Repeat with the robot connected" in out


def test_readings_at_the_torque_limit_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # The paper's steps of 0.1 rad: from the second on a servo at half its PWM gives no more than 2.05 N·m.
    path = tmp_path / "grams.csv"
    most = grams_of(1.0, 2.05)
    lines = [f"{d},{min(grams_of(18.6, d), most):.0f}" for d in (0.0, 0.03, 0.06, 0.09, 0.2, 0.3)]
    path.write_text("\n".join(lines))
    assert openant("sysid", "scale", "--readings", path) == 0
    assert "2 readings at the torque limit are left out" in capsys.readouterr().out
    path.write_text("\n".join([lines[0], *lines[-2:]]))
    assert openant("sysid", "scale", "--readings", path) == 2
    assert "smaller steps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no readings"),
        ("deflection,grams\n5.7,300\n", "line 2: a deflection of 327° → were degrees given?"),
        ("0.1,300\n0.2,many\n", "line 2: 0.2, many are no numbers"),
        ("0.1\n", "needs two columns"),
        ("0.1,nan\n", "nan g on a kitchen scale"),
        ("0.1,300\n0.2,600\n", "2 readings do not make a line"),
        ("0.1,300\n0.1,310\n0.1,305\n", "at one deflection"),
        ("0,900\n0.01,600\n0.02,300\n", "pushing harder gave less"),
    ],
)
def test_notes_that_cannot_be_are_refused_by_line(
    tmp_path: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "grams.csv").write_text(text)
    assert openant("sysid", "scale", "--readings", tmp_path / "grams.csv") == 2
    assert message in capsys.readouterr().err


def test_a_hip_needs_its_lever_arm_and_a_hanging_leg_has_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    notebook = notes(tmp_path / "grams.csv", 10.0, STEPS)
    assert openant("sysid", "scale", "--readings", notebook, "--joint", "hip_fl") == 2
    assert "--arm" in capsys.readouterr().err
    assert openant("sysid", "scale", "--readings", notebook, "--pose", "-89deg") == 2
    assert "has no lever" in capsys.readouterr().err


@given(
    stiffness=st.floats(2.0, 40.0),
    offset=st.floats(-0.3, 0.3),
    scatter=st.floats(0.0, 0.01),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=50)
def test_the_line_finds_its_slope_whatever_the_tare(stiffness: float, offset: float, scatter: float, seed: int) -> None:
    x = np.linspace(0.0, 0.1, 8)
    y = stiffness * x + offset + scatter * np.random.default_rng(seed).standard_normal(8)
    line = fit_line(x, y)
    assert line.low <= line.slope <= line.high
    # Eight readings over 0.1 rad: the slope's deviation is scatter / 0.093 rad; six of them never happen.
    assert abs(line.slope - stiffness) <= 6 * scatter / 0.093 + 1e-9


# ---- on a virtual robot whose foot is held ----


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A robot on its stand, one knee of which is stopped at −0.87 rad, with the divisor that BAM found; a floor tilted by
    0.2 rad is ready for it."""
    folder = tmp_path_factory.mktemp("held")
    scenario = folder / "held.toml"
    scenario.write_text(
        f'{COARSE}setup = "stand"\npose = "home"\n'
        "[motor]\np_divisor = 256.0\n"
        '[[effect]]\neffect = "floor_tilt"\nparameters = { angle_rad = 0.2 }\n'
        '[[effect]]\neffect = "blocked_joint"\njoints = ["knee_fl"]\nparameters = { angle_rad = -0.87 }\n'
    )
    with virtual_robot(str(scenario), clock="stepped", camera=False) as robot:
        ready = folder / "ready.json"
        ready.write_text(json.dumps(robot))
        yield {**{key: str(value) for key, value in robot.items()}, "ready": str(ready)}


def torque_is_on(robot: dict[str, str]) -> bool:
    control = VirtualControl(robot["control"])
    try:
        return any(control.ask("state")["torque_enable"].values())
    finally:
        control.close()


def test_the_servos_own_duty_tells_its_divisor_and_the_finding_is_kept(
    held: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = create_robot(tmp_path / "ant", "standard")
    notebook = notes(tmp_path / "grams.csv", SHEET_STIFFNESS / 2, [0.02, 0.04, 0.06])
    words = ["--virtual", held["ready"], "--robot", folder.path, "--readings", notebook, "--steps", 3]
    words += ["--report", tmp_path / "report"]
    assert openant("sysid", "scale", *words, "--pose", -0.87, "--yes") == 0
    assert "By the servo's own duty the P divisor is 256" in capsys.readouterr().out
    assert "divisor 256" in (tmp_path / "report" / "report.html").read_text()
    (file,) = folder.findings.glob("*.json")
    finding = json.loads(file.read_text())
    assert [round(w["deflection_rad"], 2) for w in finding["data"]["weighings"]] == [0.02, 0.04, 0.06]
    source = folder.config().provenance["bench.scale_stiffness.knee_fl"]
    assert source.how == "measured"
    assert source.recording == f"findings/{file.name}"
    assert source.low < SHEET_STIFFNESS / 2 < source.high  # type: ignore[operator]
    assert not torque_is_on(held)


def test_ctrl_c_at_the_scale_leaves_torque_off(held: dict[str, str]) -> None:
    config = config_of_unknown_robot(held["bus"], held["control"])

    def interrupted(event: Event) -> None:
        if isinstance(event, Ask):
            assert torque_is_on(held)
            raise KeyboardInterrupt

    procedure = stiffness(
        config, Pressing("knee_fl", -0.87, steps=1), Lever("knee_fl"), weigh=True, held=True, command="test"
    )
    with pytest.raises(KeyboardInterrupt):
        drive(procedure, Builder(held["control"], before=interrupted))
    assert not torque_is_on(held)


def test_a_press_beyond_the_limits_and_one_without_a_word_move_nothing(
    held: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert openant("sysid", "scale", "--virtual", held["ready"], "--pose", -1.2, "--yes") == 2
    assert "its limits are" in capsys.readouterr().err
    assert openant("sysid", "scale", "--virtual", held["ready"]) == 2
    assert "--yes" in capsys.readouterr().err


def test_a_leg_that_nothing_holds_is_no_measurement() -> None:
    free = [DutyReading(0.02 * k, 0.001, 0.004, 12.0, -0.87 - 0.02 * k) for k in range(6)]
    with pytest.raises(BadInput, match="nothing holds the leg"):
        servo_line(free, 0.5)


# ---- floor friction ----


class Level(Builder):
    """One who says that the plate is level, and touches nothing."""

    def answer(self, event: Event) -> Answer:
        return True if isinstance(event, Hands) else super().answer(event)


def test_the_papers_floor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = create_robot(tmp_path / "ant", "standard")
    angles = ["--static", "31deg", "--static", "30.5deg", "--static", "31.5deg"]
    assert openant("sysid", "tilt", *angles, "--robot", folder.path) == 0
    assert "μ = 0.60 (0.57 to 0.63)" in capsys.readouterr().out
    source = folder.config().provenance["bench.floor_friction"]
    assert source.low < 0.6 < source.high  # type: ignore[operator]


def test_static_and_kinetic_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "angles.csv"
    path.write_text(
        "angle,kind\n31deg,static\n0.55,static\n31.2deg,static\n27deg,kinetic\n26.5deg,kinetic\n27.5deg,kinetic\n"
    )
    assert openant("sysid", "tilt", "--readings", path) == 0
    out = capsys.readouterr().out
    assert "(kinetic, 3 readings)" in out
    assert "before it slides" in out
    path.write_text("\n".join(line.replace("static", "?").replace("kinetic", "static").replace("?", "kinetic")
                              for line in path.read_text().splitlines()))  # fmt: skip
    assert openant("sysid", "tilt", "--readings", path) == 1
    assert "swapped" in capsys.readouterr().out


def test_one_reading_is_no_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    assert openant("sysid", "tilt", "--static", "31deg") == 1
    assert "at least three" in capsys.readouterr().out
    assert openant("sysid", "tilt", "--static", "0.002", "--static", "0.003") == 1
    assert "did the plate tilt" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no angles"),
        (["--static", "31"], "write 31deg"),
        (["--static", "-5deg"], "a plate at"),
        (["--static", "31deg", "--imu"], "both typed and to be measured"),
    ],
)
def test_angles_that_cannot_be_are_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert openant("sysid", "tilt", *words) == 2
    assert message in capsys.readouterr().err


def test_the_accelerometer_reads_the_plate_of_a_standing_robot(
    held: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    control = VirtualControl(held["control"])
    control.ask("assemble", setup="floor")
    control.ask("advance", to=control.ask("now")["t"] + 1.0)  # the servos start up
    control.close()
    words = ["--virtual", held["ready"], "--trials", 1, "--seconds", 1, "--held", "--yes"]
    assert openant("sysid", "tilt", *words) == 1
    # tan 0.2 = 0.203; the robot leans a little downhill on its springy legs.
    at_least = float(capsys.readouterr().out.split("above ")[1].split(".\n")[0])
    assert at_least == pytest.approx(0.203, abs=0.03)
    # A plate that is called level is level, whatever gravity says: what follows is counted from there.
    config = replace(config_of_unknown_robot(held["bus"], held["control"]), imu=ImuConfig(held["imu"]))
    levelled = floor_friction(config, 1, seconds=0.5, command="test")
    (reading,) = drive(levelled, Level(held["control"])).data["readings"]
    assert reading["angle_rad"] < 0.02
    assert not torque_is_on(held)


def test_the_largest_angle_of_the_accelerometer_is_the_onset_even_while_it_slides() -> None:
    """A box on a floor whose gravity turns, up to well beyond the angle where it slides: the accelerometer never shows more."""
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><option timestep="0.002" cone="elliptic" impratio="10"/>
        <worldbody><geom type="plane" size="9 9 .1" friction=".5"/>
          <body pos="0 0 .03"><freejoint/><geom type="box" size=".1 .1 .03" mass="1" friction=".5"/><site name="s"/></body>
        </worldbody><sensor><accelerometer site="s"/></sensor></mujoco>""")
    data = mujoco.MjData(model)
    t, acc = [], []
    for k in range(3000):
        angle = 0.7 * max(0.0, k - 500) / 2500
        model.opt.gravity[:] = 9.81 * np.array([math.sin(angle), 0.0, -math.cos(angle)])
        mujoco.mj_step(model, data)
        if k % 10 == 0:
            t.append(data.time)
            acc.append(data.sensordata.copy())
    up = up_direction(np.array(acc[10:40]))
    assert math.tan(onset_angle(np.array(t), np.array(acc), up)) == pytest.approx(0.5, abs=0.02)


def test_an_accelerometer_of_wrong_scale_or_none_is_named() -> None:
    with pytest.raises(BadInput, match=r"reads 2\.45"):
        up_direction(np.full((10, 3), [0.0, 0.0, 2.4525]))
    with pytest.raises(BadInput, match="said nothing"):
        up_direction(np.full((10, 3), np.nan))
