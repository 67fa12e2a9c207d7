"""From registers to a model's numbers and back, as one does who writes an MJCF for servos out of a catalogue."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import mujoco
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.robot import gains
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.gain_models import GAIN_MODELS, GainModel, Registers, gain_model
from openant_tools.robot.gains import Rating
from openant_tools.robot.servo import SERVO_MODELS, servo_model
from openant_tools.robot.servo_gains import BackEmf, Wanted, conversion, registers_for, to_mjcf

MODELS = list(GAIN_MODELS.values())


def said(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["servo", "gains", *map(str, arguments)])
    printed = capsys.readouterr()
    assert (ended.value.code, printed.err) == (0, "")
    return printed.out


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line of a refusal, which says what to do."""
    with pytest.raises(SystemExit) as ended:
        main(["servo", "gains", *map(str, arguments)])
    printed = capsys.readouterr()
    assert (ended.value.code, printed.out) == (2, "")
    (line,) = printed.err.splitlines()
    assert "→" in line
    return line


# ---- the law ----


def test_the_numbers_of_one_servo_are_those_that_one_works_out_by_hand() -> None:
    # 800 / 128 = 6.25 counts of PWM a pulse; 4096 / 2π pulses a rad; 885 counts are 4.1 N·m: 6.25 · 651.90 / 885 · 4.1.
    assert gains.stiffness_nm_rad(800, 128, 4.1) == pytest.approx(18.876, abs=1e-3)
    assert gains.torque_limit_nm(442, 4.1) == pytest.approx(442 / 885 * 4.1)
    # 46 rev/min are 4.817 rad/s.
    line = Rating(12.0, 4.1, 2.3, 46 * 2 * math.pi / 60)
    assert gains.back_emf_damping_nm_s_rad(line) == pytest.approx(0.8511, abs=1e-4)
    assert gains.torque_constant_nm_a(line) == pytest.approx(1.783, abs=1e-3)
    assert gains.resistance_ohm(line) == pytest.approx(5.217, abs=1e-3)
    assert gains.emf_constant_v_s_rad(line) == pytest.approx(2.491, abs=1e-3)
    # 4000 / 16 = 250 counts a pulse of difference, taken once in 1 ms: 250 · 0.65190 / 885 · 1.4.
    assert gains.derivative_damping_nm_s_rad(4000, 16, 1e-3, 1.4) == pytest.approx(0.2578, abs=1e-4)
    # 400 / 65536 counts for each pulse and ms of error that has stood: 6.1035 · 651.90 / 885 · 0.215.
    assert gains.integral_gain_nm_rad_s(400, 65536, 1e-3, 0.215) == pytest.approx(0.9666, abs=1e-4)


def test_the_data_sheet_stands_at_its_own_volts_and_is_carried_on_in_proportion_beyond_them() -> None:
    xl330 = gain_model("XL330-M288").ratings
    for volts, torque in ((3.7, 0.42), (5.0, 0.52), (6.0, 0.60)):
        assert gains.stall_torque_nm(xl330, volts) == pytest.approx(torque)
    assert gains.stall_torque_nm(xl330, 7.4) == pytest.approx(0.60 * 7.4 / 6.0)
    assert gains.stall_torque_nm(xl330, 3.0) == pytest.approx(0.42 * 3.0 / 3.7)
    assert gains.stall_torque_nm(xl330, 5.5) == pytest.approx(5.5 * (0.52 / 5 + 0.60 / 6) / 2)
    assert gains.stall_torque_nm(xl330, 5.0, 0.5) == pytest.approx(0.26)


@pytest.mark.parametrize("name", SERVO_MODELS)
def test_the_open_ants_servos_have_one_law_whoever_asks(name: str) -> None:
    servo, mjcf = servo_model(name), to_mjcf(gain_model(name), gain_model(name).factory, 11.4)
    assert mjcf.kp == pytest.approx(servo.stiffness_nm_rad(supply_v=11.4))
    assert mjcf.force_nm == pytest.approx(servo.stall_torque_at(11.4))
    derivative = servo.derivative_damping_nm_s_rad(supply_v=11.4)
    assert mjcf.kv == pytest.approx(servo.electrical_damping_nm_s_rad + derivative)


def test_a_mujoco_servo_with_these_numbers_does_what_the_firmware_does() -> None:
    """Torque of the model against the law in pulses and counts, with the back-EMF in the joint, where both limit alike."""
    result = conversion(gain_model("XL430-W250"), Registers(640, 0, 4000, 442), Wanted(), 11.1, "joint")
    joint, servo = result.mjcf.lines
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body>{joint.replace("<joint", '<joint name="j"')}<geom size="0.1"/></body></worldbody>
        <actuator>{servo.replace("<position", '<position joint="j"')}</actuator></mujoco>"""
    )
    data = mujoco.MjData(model)
    for error, speed in ((0.05, 0.0), (0.05, 1.5), (-0.02, 2.0), (0.5, 0.0), (-0.5, 1.0)):
        data.ctrl[0], data.qvel[0] = error, speed
        mujoco.mj_forward(model, data)
        pulses, pulses_a_ms = error * 4096 / (2 * math.pi), speed * 4096 / (2 * math.pi) / 1000
        duty = max(-442.0, min(442.0, 640 / 128 * pulses - 4000 / 16 * pulses_a_ms)) / 885
        back_emf = 1.4 / (57 * 2 * math.pi / 60) * speed
        torque = data.qfrc_actuator[0] + data.qfrc_passive[0]
        assert torque == pytest.approx(duty * 1.4 - back_emf, abs=1e-3)


# ---- both ways ----


@given(
    model=st.sampled_from(MODELS), p=st.integers(1, 16383), d=st.integers(0, 16383), pwm=st.integers(1, 885),
    share=st.floats(0.0, 1.0), back_emf=st.sampled_from(["kv", "joint"]),
)  # fmt: skip
def test_registers_come_back_from_the_numbers_that_they_give(
    model: GainModel, p: int, d: int, pwm: int, share: float, back_emf: BackEmf
) -> None:
    low, high = model.supply_range_v
    supply = low + share * (high - low)
    registers = Registers(p, 0, d, pwm)
    mjcf = to_mjcf(model, registers, supply, back_emf)
    again = registers_for(model, Wanted(mjcf.kp, mjcf.kv, mjcf.force_nm), supply, back_emf, base=Registers(1, 0, 1, 1))
    assert again == registers


@given(model=st.sampled_from(MODELS), share=st.floats(0.001, 1.0))
def test_what_is_wanted_is_met_to_half_a_count(model: GainModel, share: float) -> None:
    stall = model.rating.stall_torque_nm
    kp = share * gains.stiffness_nm_rad(16383, model.p_divisor, stall)
    kv = gains.back_emf_damping_nm_s_rad(model.rating) + share * gains.derivative_damping_nm_s_rad(
        16383, 16, 1e-3, stall
    )
    wanted = Wanted(kp, kv, max(share, 0.01) * stall)
    got = conversion(model, model.factory, wanted, model.nominal_voltage_v).mjcf
    assert abs(got.kp - kp) <= gains.stiffness_nm_rad(0.5, model.p_divisor, stall) * (1 + 1e-9)
    assert abs(got.kv - kv) <= gains.derivative_damping_nm_s_rad(0.5, 16, 1e-3, stall) * (1 + 1e-9)
    assert wanted.force_nm is not None
    assert abs(got.force_nm - wanted.force_nm) <= gains.torque_limit_nm(0.5, stall) * (1 + 1e-9)


# ---- which servos ----


def test_each_servo_of_the_catalogue_is_a_plausible_one() -> None:
    assert set(SERVO_MODELS) < set(GAIN_MODELS)
    for family, count in (("XL330", 2), ("XC330", 4), ("XM540", 2), ("MX", 3)):
        assert sum(name.startswith(family) for name in GAIN_MODELS) == count
    assert len({model.number for model in MODELS}) == len(MODELS)
    for model in MODELS:
        low, high = model.supply_range_v
        volts = [rating.voltage_v for rating in model.ratings]
        assert volts == sorted(volts)
        assert all(low <= one <= high for one in volts)
        # kt and ke are one constant but for friction, and for a stall that the maker reads as its first peak.
        for rating in model.ratings:
            ratio = gains.torque_constant_nm_a(rating) / gains.emf_constant_v_s_rad(rating)
            assert 0.5 < ratio < 1.3, (model.name, rating)
        resistance = [gains.resistance_ohm(rating) for rating in model.ratings]
        assert max(resistance) < 1.15 * min(resistance), model.name
        assert re.fullmatch(r"https://emanual\.robotis\.com/docs/en/dxl/(x|mx)/[-a-z0-9]+/", model.url)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("xm430-w350", "XM430-W350-T"), ("XM430-W350-R", "XM430-W350-T"), ("XL330 M288", "XL330-M288-T"), ("1200", "XL330-M288-T"),
        ("XM540-W270-T/R", "XM540-W270-T"), ("Dynamixel XC330-T288-T", "XC330-T288-T"), ("MX-28", "MX-28(2.0)"), ("mx64at", "MX-64(2.0)"), ("MX-106(2.0)", "MX-106(2.0)"),
    ],
)  # fmt: skip
def test_a_servo_is_found_as_people_write_it(name: str, model: str) -> None:
    assert gain_model(name).name == model


def test_a_servo_that_is_known_for_its_gains_only_is_no_servo_of_a_robot() -> None:
    with pytest.raises(BadInput, match="no servo model has the number 1200"):
        servo_model(1200)
    with pytest.raises(BadInput, match="no servo model is called 'XL330-M288-T'"):
        servo_model("XL330-M288-T")


def test_a_robot_cannot_be_configured_with_one(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "ant", "standard")
    file = folder.config_file
    file.write_text(file.read_text().replace('model = "XM430-W350-T"', 'model = "XL330-M288-T"', 1))
    with pytest.raises(BadInput, match="XL330-M288-T"):
        folder.config()


# ---- the command ----


def test_a_builder_reads_off_what_to_write_into_the_model(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "--motor", "XM430-W350", "--supply", "12", "--position-p", "400", "--pwm-limit", "442")
    assert '<position kp="9.438" kv="0.8511" forcerange="-2.048 2.048"/>' in text
    assert re.search(r"position_p +400 +given", text)
    assert re.search(r"position_d +0 +as delivered", text)
    assert re.search(r"stall torque +4\.1 N·m +manual: https://emanual\S+/x/xm430-w350/, Specifications, at 12 V", text)
    assert re.search(r"control period +0\.001 s +assumed: not published", text)
    assert "armature and frictionloss" in text
    assert "assumed control period" not in text.split("note:", 1)[1]  # D is 0: nothing rests on it


def test_a_wanted_stiffness_is_printed_as_the_register_then_gives_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "gains.json"
    wanted = ("--kp", "10", "--kv", "1", "--forcerange", "2")
    text = said(capsys, "--motor", "XM430-W350-T", "--supply", "12", *wanted, "--json", file)
    answer = json.loads(file.read_text())
    # 10 · 128 · 885 / (651.90 · 4.1) = 423.8
    assert answer["position_p"] == 424
    assert answer["kp"] == pytest.approx(10.004, abs=1e-3)
    assert answer["kv"] == pytest.approx(1.0, abs=2e-4)
    assert answer["pwm_limit"] == 432
    assert answer["forcerange"] == pytest.approx([-2.0014, 2.0014], abs=1e-4)
    assert answer["wanted"] == {"kp": 10.0, "kv": 1.0, "forcerange": 2.0}
    assert re.search(r"position_p +424 +for 10, rounded +kp +10 N·m/rad", text)
    assert "shorter one gives less" in text
    assert {one["quantity"] for one in answer["constants"] if one["used"]} >= {"stall torque", "P divisor", "D divisor"}


def test_where_manual_and_measurement_differ_both_stand_and_one_is_used(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "gains.json"
    text = said(capsys, "--motor", "XL330-M288", "--supply", "5", "--kp", "1", "--json", file)
    measured, manual = json.loads(file.read_text())["by_p_divisor"]
    assert (measured["p_divisor"], measured["used"], manual["p_divisor"], manual["used"]) == (256, True, 128, False)
    assert "bam" in measured["source"]
    assert "emanual" in manual["source"]
    # Half the divisor, half the gain for the same stiffness.
    assert measured["position_p"] == 668
    assert manual["position_p"] == 334
    assert measured["kp"] == pytest.approx(manual["kp"], rel=1e-9)
    assert "by 128 (not used) position_p 334" in text


def test_a_stiffness_that_is_within_reach_by_one_divisor_only_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "--motor", "XL330-M288", "--supply", "5", "--kp", "0.0014")
    assert re.search(r"position_p +1 +for 0\.0014, rounded", text)
    assert "note: by a P divisor of 128: kp 0.0014 N·m/rad is less than one count" in text


def test_the_back_emf_stands_in_one_place(capsys: pytest.CaptureFixture[str]) -> None:
    alone = said(capsys, "--motor", "XL430-W250", "--supply", "11.1", "--position-d", "0")
    beside = said(capsys, "--motor", "XL430-W250", "--supply", "11.1", "--position-d", "0", "--back-emf", "joint")
    assert 'kv="0.2345"' in alone
    assert "<joint" not in alone
    assert '<joint damping="0.2345"/>' in beside
    assert 'kv="0"' in beside


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--motor", "XL330"), "more than one servo → name XL330-M077-T or XL330-M288-T"),
        (("--motor", "STS3215"), "known are XL430-W250-T"),
        (("--motor", "XM430-W350", "--kp", "1000"), "more than XM430-W350-T at 12 V can give → ask for 386.5 or less"),
        (("--motor", "XM430-W350", "--kp", "0.001"), "less than one count of the register"),
        (("--motor", "XM430-W350", "--kv", "0.1"), "back-EMF of XM430-W350-T at 12 V, 0.8511"),
        (("--motor", "XM430-W350", "--kv", "99"), "more than XM430-W350-T at 12 V can give"),
        (("--motor", "XM430-W350", "--forcerange", "4.2"), "ask for 4.1 or less"),
        (("--motor", "XM430-W350", "--kp", "3", "--position-p", "100"), "--kp and --position-p say the same"),
        (("--motor", "XM430-W350", "--kp", "nan"), "--kp is nan"),
        (("--motor", "XM430-W350", "--kp", "-3"), "-3.0 is not in the range"),
        (("--motor", "XM430-W350", "--supply", "24"), "does not run at 24 V → its maker allows 10 to 14.8 V"),
        (("--motor", "XM430-W350", "--supply", "0"), "is not in the range"),
        (("--motor", "XM430-W350", "--position-p", "16384"), "counts from 0 to 16383"),
        (("--motor", "XM430-W350", "--position-p", "-1"), "counts from 0 to 16383"),
        (("--motor", "XM430-W350", "--position-d", "2.5"), "--position-d 2.5 is no count"),
        (("--motor", "XM430-W350", "--pwm-limit", "0"), "counts from 1 to 885"),
        (("--motor", "XM430-W350", "--pwm-limit", "0.5"), "for 50 % give 442"),
        (("--motor", "XM430-W350", "--robot", "nowhere"), "nowhere"),
        ((), "--motor"),
    ],
)
def test_what_cannot_be_is_one_line(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str) -> None:
    assert words in refused(capsys, *arguments)


def test_more_volts_than_the_maker_allows_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "--motor", "XL330-M288", "--supply", "7.4")
    assert "note: 7.4 V is beyond what the maker allows, 3.7 to 6 V" in text
    assert 'forcerange="-0.74 0.74"' in text


# ---- beside a robot ----


@pytest.fixture
def robot(tmp_path: Path) -> RobotFolder:
    folder = create_robot(tmp_path / "ant", "standard")
    fitted = Provenance("fitted", "openant sysid fit", "recordings/a.mcap", None, 16.8, 17.6)
    folder.update(
        {
            "identified.stiffness.knee_fl": 17.2,
            "identified.damping.knee_fl": 0.9,
            "identified.velocity_gain.knee_fl": 0.05,
            "identified.torque_limit.knee_fl": 1.9,
            "identified.stiffness.hip_fl": 8.0,
        },
        provenance={"identified.stiffness.knee_fl": fitted},
    )
    return folder


def test_what_was_identified_stands_beside_the_data_sheet_joint_by_joint(
    robot: RobotFolder, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "gains.json"
    text = said(capsys, "--motor", "XM430-W350", "--robot", robot.path, "--json", file)
    assert "XM430-W350-T at 12 V, as the standard kit has" in text
    assert re.search(r"pwm_limit +442 +the robot's", text)
    assert re.search(
        r"knee_fl +kp +data sheet 18\.88 +identified 17\.2 \(16\.8 to 17\.6\) N·m/rad \(fitted in recordings/a\.mcap\)",
        text,
    )
    assert re.search(r"knee_fl +forcerange +data sheet 2\.048 +identified 1\.90 N·m", text)
    answer = json.loads(file.read_text())
    assert set(answer["joints"]) == {"knee_fl"}  # hips have another servo
    assert answer["joints"]["knee_fl"]["kv"]["identified"] == pytest.approx(0.95)
    assert answer["joints"]["knee_fl"]["kp"]["low"] == pytest.approx(16.8)


def test_a_robot_without_such_a_servo_or_without_a_fit_says_so(
    robot: RobotFolder, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = said(capsys, "--motor", "XM430-W210", "--robot", robot.path)
    assert "no joint of it has an XM430-W210-T; it has XC430-W240-T, XM430-W350-T" in text
    assert re.search(r"pwm_limit +885 +as delivered", text)  # the robot's limit is that of its own servos
    fresh = create_robot(tmp_path / "fresh", "lite")
    assert "nothing yet: `openant sysid fit" in said(capsys, "--motor", "XL430-W250", "--robot", fresh.path)


@pytest.mark.parametrize("spoilt", ['"stiff"', "nan", "true", "[17.2]"])
def test_an_identified_value_that_is_none_is_named(
    robot: RobotFolder, spoilt: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = robot.config_file
    file.write_text(file.read_text().replace("17.2", spoilt))
    line = refused(capsys, "--motor", "XM430-W350", "--robot", robot.path)
    assert "identified.stiffness.knee_fl is no number" in line
