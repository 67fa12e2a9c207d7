"""The virtual servo answers as the manual says a servo does, rule by rule; the bus alone is in its hands."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.protocol2 import ALERT_BIT, BROADCAST, Error, Instruction, Status
from openant_tools.robot.servo import SERVO_MODELS, servo_model
from openant_tools.virtual.servo import ServoDevice
from openant_tools.virtual.servo_power import HEAT_ERROR, Loop, Sensed, ServoSnapshot

XM, XC, XL = servo_model("XM430-W350"), servo_model("XC430-W240"), servo_model("XL430-W250")


@dataclass
class Bench:
    """A motor whose shaft is where the test puts it."""

    sensed: Sensed = field(default_factory=lambda: Sensed(pulses=2048.0))
    loop: Loop = field(default_factory=Loop)
    goals: list[float] = field(default_factory=list)
    profile: tuple[float, float, bool] = (0, 0, False)
    held: float = 0.0

    def sense(self) -> Sensed:
        return self.sensed

    def set_loop(self, loop: Loop) -> None:
        self.loop = loop

    def set_goal(self, pulses: float, *, velocity: float, acceleration: float, time_based: bool) -> None:
        self.goals.append(pulses)
        self.profile = (velocity, acceleration, time_based)

    def hold(self, pulses: float) -> None:
        self.held = pulses


class Desk:
    """One servo on a desk, and somebody who sends it packets."""

    def __init__(self, model=XM, firmware=46):
        self.motor = Bench()
        self.kept: list[ServoSnapshot] = []
        self.servo = ServoDevice(model, self.motor, firmware=firmware, persist=self.kept.append)
        self.now = 0.0

    def send(self, instruction: Instruction) -> Status | None:
        self.now += 0.001
        status = self.servo.execute(instruction, self.now)
        self.servo.replied(self.now)
        return status

    def write(self, name: str, value: int, id: int | None = None) -> int | None:
        """The status byte of a write; None for no answer."""
        register = self.servo.registers[name]
        data = (value & (1 << 8 * register.size) - 1).to_bytes(register.size, "little")
        status = self.send(p2.write(self.servo.id if id is None else id, register.address, data))
        return None if status is None else status.error

    def read(self, name: str) -> int:
        register = self.servo.registers[name]
        status = self.send(p2.read(self.servo.id, register.address, register.size))
        assert status is not None
        assert status.code == 0
        return register.decode(status.params)


@pytest.fixture
def desk() -> Desk:
    return Desk()


# ---- packets of the manual ----


def test_answers_the_manuals_packets_byte_for_byte():
    desk = Desk(servo_model("XM430-W210"), firmware=38)
    assert desk.send(p2.ping(1)).encode() == bytes.fromhex("FFFFFD00010700550006042665 5D".replace(" ", ""))
    desk.motor.sensed = Sensed(pulses=166.0)
    desk.servo.boot(0.0, mute=False)
    assert desk.send(p2.read(1, 132, 4)).encode() == bytes.fromhex("FFFFFD0001080055 00A60000008CC0".replace(" ", ""))
    assert desk.send(p2.write(1, 116, struct.pack("<i", 512))).encode() == bytes.fromhex("FFFFFD000104005500A10C")


@pytest.mark.parametrize("model", SERVO_MODELS.values(), ids=str)
def test_every_default_reads_as_the_control_table_has_it(model):
    desk = Desk(model)
    for register in desk.servo.registers.values():
        changes = ("firmware_version", "goal_pwm", "goal_current", "goal_position")
        if register.default is None or register.name in changes or 120 <= register.address < 147:
            continue
        assert desk.read(register.name) == register.default, register.name
    assert desk.read("firmware_version") == 46
    assert desk.read("goal_position") == 2048


@pytest.mark.parametrize("model", SERVO_MODELS.values(), ids=str)
def test_address_126_is_current_where_there_is_a_sensor_and_load_elsewhere(model):
    desk = Desk(model)
    desk.motor.sensed = Sensed(pulses=2048.0, current=0.538, duty=-0.25)
    status = desk.send(p2.read(1, 126, 2))
    value = int.from_bytes(status.params, "little", signed=True)
    assert value == (200 if model.has_current_sensor else -250)


# ---- access rules ----


def test_eeprom_is_locked_while_torque_is_on(desk):
    assert desk.write("return_delay_time", 10) == 0
    assert desk.write("torque_enable", 1) == 0
    assert desk.write("return_delay_time", 20) == Error.ACCESS
    assert desk.write("led", 1) == 0
    assert desk.write("torque_enable", 0) == 0
    assert desk.write("return_delay_time", 20) == 0
    assert desk.read("return_delay_time") == 20


def test_undefined_addresses_and_read_only_registers_give_access_error(desk):
    for address in (14, 66, 148, 500, 700, 1000):
        status = desk.send(p2.read(1, address, 1))
        assert (status.code, status.params) == (Error.ACCESS, b"")
        assert desk.send(p2.write(1, address, b"\0")).code == Error.ACCESS
    assert desk.write("present_temperature", 20) == Error.ACCESS
    assert desk.write("model_number", 1) == Error.ACCESS
    assert desk.send(p2.read(1, 120, 28)).code == Error.OK
    assert desk.send(p2.read(1, 120, 29)).code == Error.ACCESS


def test_models_without_current_sensor_have_no_current_registers():
    desk = Desk(XC)
    for address in (38, 102):
        assert desk.send(p2.read(1, address, 2)).code == Error.ACCESS


def test_old_firmware_lacks_what_came_later():
    old = Desk(firmware=37)
    assert old.send(p2.read(1, 98, 1)).code == Error.ACCESS
    assert old.send(p2.read(1, 60, 1)).code == Error.ACCESS
    assert old.send(p2.fast_sync_read(132, 4, [1])) is None
    assert old.send(p2.control_table_backup(1)).code == Error.INSTRUCTION
    assert old.write("drive_mode", 4) == Error.DATA_RANGE


def test_ranges_limits_and_lengths_have_their_own_codes(desk):
    assert desk.write("id", 253) == Error.DATA_RANGE
    assert desk.write("baud_rate", 8) == Error.DATA_RANGE
    assert desk.write("operating_mode", 2) == Error.DATA_RANGE
    assert desk.write("position_p_gain", 16384) == Error.DATA_RANGE
    assert desk.send(p2.write(1, 116, b"\0\0")).code == Error.DATA_LENGTH
    assert desk.send(p2.write(1, 116, b"")).code == Error.DATA_LENGTH
    assert desk.send(p2.read(1, 116, 0)).code == Error.DATA_LENGTH
    desk.write("pwm_limit", 442)
    assert desk.write("goal_pwm", 443) == Error.DATA_LIMIT
    assert desk.write("goal_pwm", -442) == 0
    desk.write("min_position_limit", 1000)
    desk.write("max_position_limit", 3000)
    assert desk.write("goal_position", 3001) == Error.DATA_LIMIT
    assert desk.write("goal_position", 999) == Error.DATA_LIMIT
    assert desk.write("goal_position", 3000) == 0


def test_a_block_write_is_checked_whole_before_any_of_it_acts(desk):
    data = struct.pack("<II", 100, 40000)
    assert desk.send(p2.write(1, 108, data)).code == Error.DATA_RANGE
    assert desk.read("profile_acceleration") == 0


def test_current_models_have_current_modes_and_others_do_not():
    assert Desk(XM).write("operating_mode", 5) == 0
    assert Desk(XL).write("operating_mode", 5) == Error.DATA_RANGE


def test_unknown_instruction_and_action_without_reg_write(desk):
    assert desk.send(Instruction(1, 0x77)).code == Error.INSTRUCTION
    assert desk.send(p2.action(1)).code == Error.INSTRUCTION


# ---- reg write, group instructions, shadow, status return level ----


def test_reg_write_waits_for_action(desk):
    assert desk.send(p2.reg_write(1, 65, b"\1")).code == 0
    assert desk.read("registered_instruction") == 1
    assert desk.read("led") == 0
    assert desk.send(p2.action()) is None
    assert desk.read("led") == 1
    assert desk.read("registered_instruction") == 0


def test_broadcasts_and_group_writes_are_never_answered(desk):
    assert desk.send(p2.write(BROADCAST, 65, b"\1")) is None
    assert desk.read("led") == 1
    assert desk.send(p2.read(BROADCAST, 65, 1)) is None
    assert desk.send(p2.sync_write(65, 1, {2: b"\0", 1: b"\0"})) is None
    assert desk.read("led") == 0
    assert desk.send(p2.bulk_write([(1, 65, b"\1"), (2, 65, b"\0")])) is None
    assert desk.read("led") == 1
    assert desk.send(p2.sync_read(65, 1, [2, 3])) is None
    assert desk.send(p2.bulk_read([(2, 65, 1), (1, 65, 1)])) == Status(1, 0, b"\1")


def test_shadow_id_obeys_in_silence_and_not_in_eeprom(desk):
    assert desk.write("secondary_id", 7) == 0
    assert desk.write("led", 1, id=7) is None
    assert desk.read("led") == 1
    assert desk.write("return_delay_time", 0, id=7) is None
    assert desk.read("return_delay_time") == 250
    assert desk.send(p2.ping(7)) is None


def test_status_return_level_silences_all_but_ping(desk):
    assert desk.write("status_return_level", 1) is None
    assert desk.write("led", 1) is None
    assert desk.read("led") == 1
    desk.write("status_return_level", 0)
    assert desk.send(p2.read(1, 65, 1)) is None
    assert desk.send(p2.ping(1)) is not None


# ---- id, baud, reboot, reset, backup ----


def test_the_reply_to_a_new_id_carries_the_old_one(desk):
    assert desk.send(p2.write(1, 7, b"\x0a")).id == 1
    assert desk.send(p2.ping(1)) is None
    assert desk.send(p2.ping(10)).id == 10


def test_a_new_baud_rate_holds_once_the_reply_has_left(desk):
    assert desk.servo.baud == 57_600
    desk.servo.execute(p2.write(1, 8, b"\x03"), 1.0)
    assert desk.servo.baud == 57_600
    desk.servo.replied(1.001)
    assert desk.servo.baud == 1_000_000


def test_reboot_is_mute_for_a_while_and_forgets_ram(desk):
    desk.write("led", 1)
    desk.write("torque_enable", 1)
    assert desk.send(p2.reboot(1)).code == 0
    assert desk.send(p2.ping(1)) is None
    assert not desk.motor.loop.torque
    desk.now += 0.5
    assert desk.read("led") == 0
    assert desk.read("realtime_tick") < 600


def test_factory_reset_keeps_what_it_is_told_to_keep(desk):
    desk.write("id", 9)
    desk.write("baud_rate", 3)
    desk.write("pwm_limit", 400)
    assert desk.send(p2.factory_reset(9, 2)).code == 0
    desk.now += 1
    assert (desk.servo.id, desk.servo.baud, desk.read("pwm_limit")) == (9, 1_000_000, 885)
    desk.send(p2.factory_reset(9, 1))
    desk.now += 1
    assert (desk.servo.id, desk.servo.baud) == (9, 57_600)
    assert desk.send(p2.factory_reset(9, 7)).code == Error.DATA_RANGE
    desk.send(p2.factory_reset(BROADCAST, 0xFF))
    assert desk.servo.id == 9, "a broadcast of everything is ignored"
    desk.send(p2.factory_reset(9, 0xFF))
    assert desk.servo.id == 1


def test_eeprom_outlives_power_and_ram_does_not(desk):
    desk.write("id", 12)
    desk.write("led", 1)
    fresh = Desk()
    fresh.servo.load(desk.kept[-1])
    assert fresh.servo.id == 12
    assert fresh.read("led") == 0


def test_backup_and_restore_need_torque_off(desk):
    desk.write("pwm_limit", 500)
    desk.write("torque_enable", 1)
    assert desk.send(p2.control_table_backup(1)).code == Error.RESULT_FAIL
    desk.write("torque_enable", 0)
    assert desk.read("backup_ready") == 0
    assert desk.send(p2.control_table_backup(1)).code == 0
    assert desk.read("backup_ready") == 1
    desk.write("pwm_limit", 100)
    assert desk.send(p2.control_table_restore(1)).code == 0
    desk.now += 1
    assert desk.read("pwm_limit") == 500


def test_startup_configuration_brings_torque_and_ram_back(desk):
    desk.write("startup_configuration", 3)
    desk.write("position_p_gain", 333)
    desk.send(p2.control_table_backup(1))
    desk.write("position_p_gain", 100)
    desk.send(p2.reboot(1))
    desk.now += 1
    assert desk.read("position_p_gain") == 333
    assert desk.read("torque_enable") == 1


# ---- position ----


def test_position_counts_on_over_turns_until_it_is_folded(desk):
    desk.motor.sensed = Sensed(pulses=5000.0)
    assert desk.read("present_position") == 5000
    desk.write("torque_enable", 1)
    assert desk.read("present_position") == 5000 - 4096
    assert desk.motor.loop.offset == -4096
    desk.write("torque_enable", 0)
    desk.write("operating_mode", 4)
    desk.motor.sensed = Sensed(pulses=-100.0)
    desk.write("torque_enable", 1)
    assert desk.read("present_position") == -100 - 4096, "extended mode keeps its turns"


def test_clear_folds_at_standstill_only(desk):
    desk.write("operating_mode", 4)
    desk.motor.sensed = Sensed(pulses=9000.0, velocity=1.0)
    assert desk.send(p2.clear_multi_turn(1)).code == Error.RESULT_FAIL
    desk.motor.sensed = Sensed(pulses=9000.0)
    assert desk.send(p2.clear_multi_turn(1)).code == 0
    assert desk.read("present_position") == 9000 % 4096


def test_homing_offset_shifts_and_is_ignored_beyond_a_quarter_turn_in_position_mode(desk):
    desk.write("homing_offset", 100)
    assert desk.read("present_position") == 2148
    desk.write("homing_offset", -1025)
    assert desk.read("present_position") == 2048
    desk.write("operating_mode", 4)
    assert desk.read("present_position") == 2048 - 1025


def test_reverse_mode_turns_position_but_not_the_offset(desk):
    desk.motor.sensed = Sensed(pulses=1000.0, velocity=0.24)
    desk.write("drive_mode", 1)
    assert desk.read("present_position") == 4096 - 1000
    assert desk.read("present_velocity") == -10
    desk.write("homing_offset", 100)
    assert desk.read("present_position") == 4096 - 1000 + 100
    assert desk.motor.loop.direction == -1


def test_torque_on_stands_where_the_shaft_is(desk):
    desk.motor.sensed = Sensed(pulses=2500.0)
    desk.write("torque_enable", 1)
    assert desk.read("goal_position") == 2500
    assert desk.motor.held == 2500
    assert desk.motor.goals == []


def test_a_goal_takes_the_profile_of_its_moment(desk):
    desk.write("torque_enable", 1)
    desk.write("profile_velocity", 100)
    desk.write("profile_acceleration", 10)
    desk.write("goal_position", 2600)
    assert desk.motor.goals == [2600]
    assert desk.motor.profile == (100, 10, False)


def test_drive_mode_can_switch_torque_on_by_the_goal(desk):
    desk.write("goal_position", 2600)
    assert desk.motor.goals == []
    desk.write("drive_mode", 8)
    desk.write("goal_position", 2600)
    assert desk.read("torque_enable") == 1
    assert desk.motor.goals == [2600]


def test_a_new_mode_starts_from_its_defaults(desk):
    desk.write("position_p_gain", 100)
    desk.write("profile_velocity", 50)
    desk.write("pwm_limit", 442)
    desk.write("goal_pwm", 100)
    desk.write("operating_mode", 4)
    assert desk.read("position_p_gain") == 800
    assert desk.read("profile_velocity") == 0
    assert desk.read("goal_pwm") == 442


# ---- protection ----


def test_overheating_latches_shuts_down_and_shows_the_alert_bit(desk):
    desk.write("torque_enable", 1)
    desk.servo.protect(12.0, 81.0)
    assert desk.send(p2.ping(1)).error == ALERT_BIT
    assert desk.servo.memory[64] == 0
    assert not desk.motor.loop.torque
    desk.servo.protect(12.0, 40.0)
    assert desk.write("torque_enable", 1) == ALERT_BIT | Error.RESULT_FAIL
    desk.send(p2.reboot(1))
    desk.now += 1
    assert desk.read("hardware_error_status") == 0
    assert desk.write("torque_enable", 1) == 0


def test_an_error_outside_the_mask_only_alerts(desk):
    desk.write("shutdown", 0x20)
    desk.write("torque_enable", 1)
    desk.servo.raise_hardware_error(HEAT_ERROR)
    assert desk.send(p2.read(1, 64, 1)) == Status(1, ALERT_BIT, b"\1")


def test_voltage_outside_its_limits_is_bit_0(desk):
    desk.servo.protect(9.0, 30.0)
    assert desk.servo.memory[70] == 1
    assert desk.servo.torque is False
    assert not desk.servo.shut_down, "the factory's mask leaves voltage out"


def test_watchdog_stops_locks_the_goals_and_is_cleared_by_zero(desk):
    desk.write("profile_velocity", 50)
    desk.write("bus_watchdog", 10)
    desk.servo.watch_bus(desk.now + 1)
    assert desk.read("bus_watchdog") == 10, "it counts only while torque is on"
    desk.write("torque_enable", 1)
    desk.write("goal_position", 2600)
    desk.servo.watch_bus(desk.now + 0.19)
    assert desk.read("bus_watchdog") == 10
    desk.servo.watch_bus(desk.now + 0.21)
    assert desk.read("bus_watchdog") == -1
    assert desk.read("torque_enable") == 1
    assert desk.motor.held == 2048
    assert desk.read("profile_velocity") == 0
    assert desk.write("goal_position", 2100) == Error.DATA_RANGE
    assert desk.write("goal_pwm", 0) == Error.DATA_RANGE
    assert desk.write("bus_watchdog", 5) == Error.DATA_RANGE
    assert desk.write("bus_watchdog", 0) == 0
    assert desk.write("goal_position", 2100) == 0


def test_any_instruction_on_the_bus_feeds_the_watchdog(desk):
    desk.write("bus_watchdog", 1)
    desk.write("torque_enable", 1)
    for _ in range(100):
        desk.now += 0.015
        desk.send(p2.ping(200))
        desk.servo.watch_bus(desk.now)
    assert desk.read("bus_watchdog") == 1


def test_tick_wraps_after_32767_ms(desk):
    desk.now = 32.7665
    assert desk.read("realtime_tick") == 32767
    assert desk.read("realtime_tick") == 0


def test_moving_status_tells_profile_and_arrival(desk):
    desk.write("torque_enable", 1)
    desk.motor.sensed = Sensed(pulses=2048.0, trajectory=2048.0, profile_active=True, profile_shape=3)
    assert desk.read("moving") == 1
    assert desk.read("moving_status") == 0b110011
    desk.motor.sensed = Sensed(pulses=2048.0, velocity=0.1, trajectory=2048.0)
    assert desk.read("moving") == 0, "below the moving threshold"


# ---- indirect cells ----


def test_indirect_cells_read_and_write_what_they_point_to(desk):
    for n, target in enumerate((146, 132, 133, 134, 135)):
        desk.write(f"indirect_address_{n + 1}", target)
    desk.motor.sensed = Sensed(pulses=2048.0, temperature=33.0)
    assert desk.send(p2.read(1, 224, 5)).params == bytes([33, 0, 8, 0, 0])
    for n in range(4):
        desk.write(f"indirect_address_{n + 1}", 116 + n)
    assert desk.send(p2.write(1, 224, struct.pack("<i", 2100))).code == 0
    assert desk.read("goal_position") == 2100
    assert desk.send(p2.write(1, 224, b"\0\0")).code == Error.DATA_LENGTH
    desk.write("indirect_address_1", 146)
    assert desk.send(p2.write(1, 224, b"\0")).code == Error.ACCESS
    assert desk.write("indirect_address_1", 7) == Error.DATA_RANGE, "EEPROM cannot be mapped"


def test_indirect_cells_keep_bytes_of_their_own_until_they_are_mapped(desk):
    assert desk.send(p2.write(1, 634, b"\x55")).code == 0
    assert desk.send(p2.read(1, 634, 1)).params == b"\x55"


# ---- whatever comes ----


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([1, 1, 1, 7, BROADCAST]),
            st.one_of(st.sampled_from([int(i) for i in p2.Inst]), st.integers(0, 255)),
            st.binary(max_size=40),
        ),
        max_size=8,
    )
)
def test_no_instruction_makes_it_raise(instructions):
    desk = Desk()
    desk.write("secondary_id", 7)
    for id, code, params in instructions:
        status = desk.send(Instruction(id, code, params))
        desk.servo.watch_bus(desk.now)
        if status is not None:
            assert p2.Parser().feed(status.encode()) == [status]


@settings(max_examples=150)
@given(address=st.integers(0, 1023), data=st.binary(min_size=1, max_size=12))
def test_a_write_is_either_refused_whole_or_reads_back(address, data):
    desk = Desk()
    before = bytes(desk.servo.memory)
    status = desk.send(p2.write(1, address, data))
    if status is None:
        # Status Return Level was written: nothing more will answer.
        assert address <= 68 < address + len(data)
    elif status.code:
        assert bytes(desk.servo.memory) == before
    elif desk.servo.id == 1 and address >= 64:
        back = desk.send(p2.read(desk.servo.id, address, len(data)))
        if back is not None and not (address + len(data) >= 168 and address < 690):
            assert back.params == data
