"""The servo models as data: what a driver, an emulator and a fit take from them."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.servo import (
    BAUD_CODES,
    SERVO_MODELS,
    Register,
    ServoModel,
    baud_code,
    hardware_errors,
    servo_model,
)

MODELS = list(SERVO_MODELS.values())
REGISTERS = [(model, register) for model in MODELS for register in model.registers.values()]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)


def test_joints_stand_in_the_platforms_order_with_its_ids() -> None:
    assert JOINT_NAMES == ("hip_rr", "knee_rr", "hip_fr", "knee_fr", "hip_fl", "knee_fl", "hip_rl", "knee_rl")
    assert [joint.id for joint in JOINTS.values()] == [10, 11, 20, 21, 30, 31, 40, 41]
    for joint in JOINTS.values():
        outwards = (joint.leg.x_sign, joint.leg.y_sign, 0)
        motion = np.cross(joint.axis, outwards)
        if joint.kind == "knee":
            assert motion[2] > 0, "a positive knee lifts the tip of its leg"
        else:
            assert joint.axis == (0, 0, 1)


def test_models_are_found_by_name_and_number() -> None:
    assert [servo_model(number).name for number in (1060, 1080, 1030, 1020)] == [
        "XL430-W250-T", "XC430-W240-T", "XM430-W210-T", "XM430-W350-T",
    ]  # fmt: skip
    assert servo_model("xm430-w350") is servo_model("XM430-W350-T")
    for model in MODELS:
        assert model.register("model_number").default == model.number


def test_an_unknown_model_or_register_names_the_nearest() -> None:
    with pytest.raises(BadInput, match=r"XM430-W351-T.*did you mean 'XM430-W350-T'"):
        servo_model("XM430-W351-T")
    with pytest.raises(BadInput, match=r"number 1021 → known are 1060 \(XL430-W250-T\)"):
        servo_model(1021)
    with pytest.raises(BadInput, match="XL430-W250-T has no register 'present_positon' → did you mean 'present_pos"):
        servo_model("XL430-W250-T").register("present_positon")
    with pytest.raises(BadInput, match="has no register 'goal_current'"):
        servo_model("XL430-W250-T").register("goal_current")


@every_model
def test_a_table_has_no_overlaps_and_keeps_its_defaults_in_range(model: ServoModel) -> None:
    end = 0
    for register in model.registers.values():
        assert register.address >= end, register
        end = register.end
        low, high = register.range
        assert low <= high
        if register.default is not None:
            assert low <= register.default <= high, register
            assert register.decode(register.encode(register.default)) == register.default
        assert register.area == ("EEPROM" if register.address < 64 else "RAM")
    assert end == 662


@every_model
def test_indirect_cells_stand_where_the_manual_puts_them(model: ServoModel) -> None:
    cells = [(1, 168, 224), (28, 222, 251), (29, 578, 634), (56, 632, 661)]
    for number, address, data in cells:
        assert model.register(f"indirect_address_{number}").address == address
        assert model.register(f"indirect_address_{number}").default == data
        assert model.register(f"indirect_data_{number}").address == data


def test_models_differ_where_the_manual_says_so() -> None:
    xl, xc, w210, w350 = (servo_model(number) for number in (1060, 1080, 1030, 1020))
    defaults = {
        "temperature_limit": (72, 80, 80, 80), "max_voltage_limit": (140, 160, 160, 160),
        "min_voltage_limit": (60, 60, 95, 95), "velocity_limit": (265, 306, 330, 200),
        "velocity_i_gain": (1000, 1920, 1920, 1920), "position_d_gain": (4000, 0, 0, 0),
        "position_p_gain": (640, 700, 800, 800), "return_delay_time": (250,) * 4, "shutdown": (0x34,) * 4,
    }  # fmt: skip
    for name, values in defaults.items():
        assert tuple(model.register(name).default for model in (xl, xc, w210, w350)) == values, name
    assert [model.effort.name for model in (xl, xc, w210, w350)] == ["present_load"] * 2 + ["present_current"] * 2
    assert (5 in w350.modes, 5 in xl.modes) == (True, False)


def test_units_are_the_manuals() -> None:
    model = servo_model("XM430-W350-T")

    def one(name: str, counts: int) -> float:
        return model.register(name).to_si(counts)

    assert one("present_position", 4096) == pytest.approx(2 * math.pi)
    assert one("present_velocity", 1) == pytest.approx(0.0239808, rel=1e-4)
    assert one("present_pwm", 885) == pytest.approx(1)
    assert one("present_current", 1000) == pytest.approx(2.69)
    assert one("present_input_voltage", 121) == pytest.approx(12.1)
    assert one("return_delay_time", 250) == pytest.approx(500e-6)
    assert one("bus_watchdog", 10) == pytest.approx(0.2)
    assert servo_model("XL430-W250-T").register("present_load").to_si(-1000) == pytest.approx(-1)
    np.testing.assert_allclose(model.register("present_position").to_si(np.array([0, 1024])), [0, math.pi / 2])


def test_a_range_is_checked_in_words() -> None:
    register = servo_model("XM430-W350-T").register("return_delay_time")
    assert register.to_counts(0.0) == 0
    with pytest.raises(
        BadInput, match=r"return_delay_time cannot be 500 \(it goes from 0 to 254, that is 0 to 0.000508 s"
    ):
        register.to_counts(1e-3)
    with pytest.raises(BadInput, match="cannot be set to nan"):
        register.to_counts(math.nan)
    with pytest.raises(BadInput, match="300 does not fit into the 1 bytes of id"):
        servo_model(1020).register("id").encode(300)
    with pytest.raises(BadInput, match="present_position has 4 bytes, not 3"):
        servo_model(1020).register("present_position").decode(b"\0\0\0")


@given(case=st.sampled_from(REGISTERS), data=st.data())
def test_bytes_and_units_survive_both_ways(case: tuple[ServoModel, Register], data: st.DataObject) -> None:
    register = case[1]
    low, high = register.range
    counts = data.draw(st.integers(low, high))
    assert register.decode(register.encode(counts)) == counts
    assert register.to_counts(register.to_si(counts)) == counts


def test_stiffness_follows_the_register_and_the_supply() -> None:
    knee = servo_model("XM430-W350-T")
    # P 800 → 6.25 counts of PWM a pulse; the platform's authors measured 18.64 N·m/rad with a kitchen scale.
    assert knee.stiffness_nm_rad(800, 12.0) == pytest.approx(18.9, abs=0.05)
    assert knee.stiffness_nm_rad(400) == pytest.approx(knee.stiffness_nm_rad() / 2)
    assert knee.stiffness_nm_rad(supply_v=14.8) == pytest.approx(knee.stiffness_nm_rad() * 4.8 / 4.1)
    assert servo_model("XL430-W250-T").stiffness_nm_rad() == pytest.approx(5.16, abs=0.01)


def test_motor_constants_follow_from_the_data_sheet() -> None:
    for name, damping, kt, ohm, ke in (
        ("XL430-W250-T", 0.235, 1.07, 8.57, 1.88), ("XC430-W240-T", 0.259, 1.36, 8.57, 1.64),
        ("XM430-W210-T", 0.372, 1.30, 5.22, 1.49), ("XM430-W350-T", 0.851, 1.78, 5.22, 2.49),
    ):  # fmt: skip
        model = servo_model(name)
        assert model.electrical_damping_nm_s_rad == pytest.approx(damping, abs=1e-3)
        assert model.kt_nm_a == pytest.approx(kt, rel=0.01)
        assert model.resistance_ohm == pytest.approx(ohm, rel=0.01)
        assert model.ke_v_s_rad == pytest.approx(ke, rel=0.02)
        for rating in model.ratings:
            assert model.stall_torque_at(rating.voltage_v) == pytest.approx(rating.stall_torque_nm, rel=0.15)
            no_load = model.no_load_rad_s * rating.voltage_v / model.nominal_voltage_v
            assert no_load == pytest.approx(rating.no_load_rad_s, rel=0.15)


def test_bits_read_as_words_with_advice() -> None:
    assert [error.name for error in hardware_errors(0x34)] == ["overheating", "electrical shock", "overload"]
    assert hardware_errors(0) == ()
    assert hardware_errors(0x3D)[0].name == "input voltage"
    assert "20 minutes" in hardware_errors(4)[0].advice


def test_baud_codes_go_both_ways() -> None:
    assert {baud_code(rate) for rate in BAUD_CODES.values()} == set(BAUD_CODES)
    with pytest.raises(BadInput, match="no servo speaks 500000 baud → use one of 9600"):
        baud_code(500_000)


def test_models_travel_between_processes() -> None:
    for model in MODELS:
        again = pickle.loads(pickle.dumps(model))
        assert again == model
        assert again.registers == model.registers
