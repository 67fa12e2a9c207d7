"""The bus driver against the virtual wire, byte for byte and fault for fault: what a builder meets."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from wire import IDS, ant

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import FAST_AGAIN, Answer, BusTiming
from openant_tools.comms.faults import BrokenAnswer, Cause, NoAnswer, Refused
from openant_tools.comms.guards import Guards, Trip, Watch
from openant_tools.comms.line import PortGone
from openant_tools.comms.servos import Servo, Servos
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit
from openant_tools.virtual.bus import BusSettings


def robot(**options: object) -> tuple[Servos, object]:
    bus, line = ant(**options)  # type: ignore[arg-type]
    servos = [Servo(joint.name, joint.id, kit("standard").servo(joint.kind), 1, 3.14159) for joint in JOINTS.values()]
    return Servos(bus, servos), line


def test_everyone_is_found() -> None:
    bus, _ = ant()
    assert [servo.id for servo in bus.broadcast_ping()] == IDS
    found = bus.ping(11)
    assert found is not None
    assert (found.model_number, found.firmware) == (1020, 46)
    assert bus.ping(12) is None


def test_a_block_of_all_servos_takes_the_wire_time_and_no_more() -> None:
    bus, line = ant()
    before = line.now()
    answers = bus.sync_read(120, 27, IDS)
    assert all(answer.ok and len(answer.data or b"") == 27 for answer in answers)
    # 3.26 ms on the wire (dynamixel facts C6), and up to one latency timer.
    assert 3.2e-3 < line.now() - before < 4.5e-3


def test_fast_sync_read_gives_the_same_with_fewer_bytes() -> None:
    bus, line = ant()
    plain = bus.sync_read(132, 4, IDS)
    before = line.received
    bus.fast = set(IDS)
    fast = bus.sync_read(132, 4, IDS)
    assert [answer.data for answer in fast] == [answer.data for answer in plain]
    assert line.received - before == 8 + 8 * (4 + 4)


def test_fast_read_falls_back_and_keeps_what_was_verified() -> None:
    bus, line = ant()
    bus.fast = set(IDS)
    line.wire.settings.lost[4] = 1.0
    answers = bus.sync_read(132, 4, IDS)
    assert [answer.ok for answer in answers] == [True] * 4 + [False] + [False] * 3
    assert bus.statistics.fast_read_fallbacks == 1
    line.wire.settings.lost.clear()
    assert all(answer.ok for answer in bus.sync_read(132, 4, IDS))


def test_fast_reads_come_back_once_the_silent_servo_has_answered_for_a_while() -> None:
    bus, line = ant()
    bus.fast = set(IDS)

    def bytes_of_a_read() -> int:
        before = line.received
        bus.sync_read(132, 4, IDS)
        return line.received - before

    joined, plain = 8 + 8 * 8, 8 * 15
    for fallbacks, wait in ((1, FAST_AGAIN), (2, 2 * FAST_AGAIN)):
        line.wire.settings.lost[4] = 1.0
        for _ in range(20):
            bytes_of_a_read()
        line.wire.settings.lost.clear()
        # The first answer of a servo that was silent for so long may be a late one: it counts for nothing.
        assert [bytes_of_a_read() for _ in range(1 + wait)] == [plain] * (1 + wait)
        assert bytes_of_a_read() == joined
        assert (bus.statistics.fast_read_fallbacks, bus.statistics.fast_read_returns) == (fallbacks, fallbacks)


# ---- the guard against silence on a noisy line -------------------------------------------------------------------


def cycles_until_stopped(byte_error: float, seed: int, cycles: int) -> tuple[float, Trip] | None:
    """Write and read at 100 Hz as the engine does; (s, why) it stops, None where it goes on."""
    bus, line = ant(settings=BusSettings(byte_error=byte_error), seed=seed)
    servos = Servos(bus, [Servo(joint.name, joint.id, kit("standard").servo(joint.kind)) for joint in JOINTS.values()])
    bus.fast = set(IDS)
    for _ in range(20):  # torque is off for a while first
        line.sleep_until(line.now() + 0.01)
        servos.read_blocks()
    start = line.now()
    watch = Watch(Guards(), servos.servos, {})
    watch.reset(start)
    for n in range(cycles):
        line.sleep_until(start + n * 0.01)
        servos.write_goals([2048] * 8)
        answers = servos.read_blocks()
        trip = watch.check(bus.request_at, answers)
        if trip is not None:
            return line.now() - start, trip
    return None


@pytest.mark.parametrize("seed", range(3))
def test_one_byte_in_a_hundred_broken_costs_answers_and_never_the_motion(seed: int) -> None:
    assert cycles_until_stopped(0.01, seed, 1000) is None


@pytest.mark.parametrize("seed", range(5))
def test_one_byte_in_ten_broken_stops_the_motion_within_half_a_second_and_is_called_noise(seed: int) -> None:
    stopped = cycles_until_stopped(0.1, seed, 1000)
    assert stopped is not None
    seconds, trip = stopped
    assert seconds < 0.5
    assert re.match(r"[5-8] of 8 servos have not been heard for up to 0\.[2-4]\d s, what comes is broken", trip.what)
    assert "noise on the bus" in trip.remedy


def test_a_busy_host_is_no_silent_servo() -> None:
    servos = [Servo("hip_rr", 10, kit("standard").servo("hip"))]
    watch = Watch(Guards(), servos, {})
    watch.reset(0.0)
    missed = [(Answer(10, None, 0, Cause.TIMEOUT), None)]
    assert watch.check(0.3, missed) is None, "asked once in 0.3 s"
    trip = watch.check(0.41, missed)
    assert trip is not None
    assert "hip_rr (id 10) has not answered for 0.41 s (2 × no answer)" in trip.what
    watch.reset(0.0)
    assert watch.check(1.0, missed) is None, "asked once in a second"
    assert watch.check(1.05, missed) is None, "a noisy line loses two in a row"
    assert watch.check(1.41, missed) is not None
    watch.reset(0.0)
    assert [watch.check(0.5 * n, missed) is None for n in (1, 2, 3)] == [True, False, False], "asked twice a second"
    watch.reset(0.0)
    assert [watch.check(t, missed) is None for t in (0.5, 0.52, 1.02)] == [True, True, False], "now slowly, now at once"


def test_one_silent_servo_does_not_hide_those_behind_it() -> None:
    bus, line = ant()
    line.wire.settings.waits_for_silent = False
    line.wire.settings.lost[3] = 1.0
    answers = bus.sync_read(132, 4, IDS)
    assert [answer.cause for answer in answers] == [None] * 3 + [Cause.TIMEOUT] + [None] * 4
    with pytest.raises(NoAnswer, match="1 of 8 servos did not answer: knee_fr"):
        bus.require(answers)


def test_who_is_silent_is_said_and_where_the_silence_begins() -> None:
    bus, line = ant()
    line.wire.settings.lost |= dict.fromkeys(range(3, 8), 1.0)
    with pytest.raises(NoAnswer, match="the first 3 of 8 servos answered, then silence from knee_fr") as error:
        bus.require(bus.sync_read(132, 4, IDS))
    assert error.value.ids == tuple(IDS[3:])
    assert "cable" not in str(error.value)  # not before all else is excluded, see test_silence


def test_nothing_at_all_says_so() -> None:
    bus, line = ant()
    line.set_baud(57_600)
    with pytest.raises(NoAnswer, match=r"nothing answered at 57600 baud: none of 8 servos"):
        bus.require(bus.sync_read(132, 4, IDS))
    with pytest.raises(NoAnswer, match=r"hip_rr \(id 10\) does not answer at 57600 baud"):
        bus.read(10, 132, 4)
    assert bus.statistics.of(10).retries == bus.retries


def test_broken_bytes_are_a_cause_of_their_own_and_never_a_value() -> None:
    bus, line = ant()
    line.wire.settings.byte_error = 0.01
    causes = set()
    for _ in range(300):
        for answer in bus.sync_read(132, 4, IDS):
            causes.add(answer.cause)
            assert not answer.ok or answer.data == (2048).to_bytes(4, "little")
    assert {None, Cause.CRC} <= causes
    lost = sum(sum(servo.lost.values()) for servo in bus.statistics.servos.values())
    assert 0 < lost < 300 * 8


def test_every_retry_is_counted() -> None:
    bus, line = ant()
    line.wire.settings.lost[0] = 0.5
    for _ in range(50):
        try:
            bus.read(10, 132, 4)
        except NoAnswer:
            pass
    servo = bus.statistics.of(10)
    assert servo.retries > 0
    assert servo.asked == servo.answered + sum(servo.lost.values())


def test_a_late_answer_is_late_not_lost() -> None:
    bus, line = ant(BusTiming(return_delay_s=0.0, latency_timer_s=1e-3, margin_s=0.1e-3))
    line.wire.servos[0].set("return_delay_time", 254)
    line.wire.settings.response_s = 2.5e-3
    [answer] = bus.sync_read(132, 4, [10])
    assert answer.cause is Cause.LATE
    assert answer.data is not None
    assert answer.rtt is not None
    assert answer.rtt > 2.5e-3


def test_an_answer_to_an_earlier_question_is_not_taken_for_this_one() -> None:
    bus, line = ant()
    bus.retries = 0
    for delay in (6e-3, 10e-3, 12e-3, 20e-3):
        line.wire.settings.response_s = delay
        bus.ping(10)  # its answer, or not, comes whenever
        line.wire.settings.response_s = 0.0
        try:
            assert bus.read(10, 84, 2) == (700).to_bytes(2, "little")
        except NoAnswer:
            pass  # the late answer was on the wire when we asked


def test_the_write_to_read_gap_is_kept() -> None:
    bus, _ = ant()
    for _ in range(50):
        left = bus.sync_write(116, 4, dict.fromkeys(IDS, bytes(4)))
        assert all(answer.ok for answer in bus.sync_read(132, 4, IDS))
        assert bus.request_at >= left + 0.2e-3 - 1e-9
    bus, _ = ant(BusTiming(return_delay_s=0.0, latency_timer_s=1e-3, write_read_gap_s=0.0))
    heard = [all(answer.ok for answer in bus.sync_read(120, 27, IDS))]
    for _ in range(50):
        bus.sync_write(116, 4, dict.fromkeys(IDS, bytes(4)))
        heard.append(all(answer.ok for answer in bus.sync_read(120, 27, IDS)))
    assert sum(heard) < 10


def test_values_that_need_stuffing_arrive() -> None:
    bus, line = ant()
    # Bytes FF FF FD FF: a position just past minus 32 turns.
    line.wire.servos[0].motor.sensed.pulses = -131073.0  # type: ignore[attr-defined]
    data = bus.read(10, 132, 4)
    answers = bus.sync_read(132, 4, IDS)
    assert answers[0].data == data
    assert all(answer.ok for answer in answers)


def test_unplugging_is_told_as_such() -> None:
    bus, line = ant()
    line.unplugged = True
    with pytest.raises(PortGone, match=r"the port is gone .* USB cable"):
        bus.sync_read(132, 4, IDS)


def test_colliding_answers_of_fresh_servos() -> None:
    bus, line = ant()
    for servo in line.wire.servos:
        servo.set("id", 1)
    with pytest.raises(BrokenAnswer, match="share an id, as factory-fresh ones do: connect one at a time"):
        bus.broadcast_ping()


def test_all_other_instructions() -> None:
    bus, line = ant()
    bus.reg_write(10, 65, b"\x01")
    assert bus.read(10, 65, 1) == b"\x00"
    bus.action(10)
    assert bus.read(10, 65, 1) == b"\x01"
    bus.bulk_write([(10, 65, b"\x00"), (11, 84, (500).to_bytes(2, "little"))])
    answers = bus.bulk_read([(10, 65, 1), (11, 84, 2)])
    assert [answer.data for answer in answers] == [b"\x00", b"\xf4\x01"]
    bus.backup(11)
    bus.clear_multi_turn(11)
    bus.reboot(11)
    assert bus.ping(11) is None
    line.sleep_until(line.now() + 1.0)
    assert bus.ping(11) is not None
    bus.factory_reset(11, 0x02)
    line.sleep_until(line.now() + 1.0)
    assert bus.ping(11) is not None


# ---- registers by joint and name ---------------------------------------------------------------------------------


def test_registers_speak_si() -> None:
    servos, _ = robot()
    assert servos.read("present_position", "hip_rr") == pytest.approx(3.14159, abs=1e-3)
    assert servos.read("present_input_voltage", "knee_fl") == pytest.approx(12.0)
    servos.write("profile_velocity", "hip_rr", 1.0)
    assert servos.read("profile_velocity", "hip_rr") == pytest.approx(1.0, abs=0.012)


def test_unknown_registers_and_joints_are_named() -> None:
    servos, _ = robot()
    with pytest.raises(BadInput, match="did you mean 'position_p_gain'"):
        servos.read("position_p_gian", "hip_rr")
    with pytest.raises(BadInput, match="no joint 'hip_xx'"):
        servos.read("id", "hip_xx")
    with pytest.raises(BadInput, match="position_p_gain cannot be 20000"):
        servos.write_counts("position_p_gain", "hip_rr", 20000)


def test_eeprom_is_written_only_where_it_differs_and_stands_in_the_journal() -> None:
    servos, _ = robot()
    servos.write_counts("pwm_limit", "knee_fl", 442)
    servos.write_counts("pwm_limit", "knee_fl", 442)
    [write] = servos.journal
    assert (write.joint, write.register, write.old, write.new) == ("knee_fl", "pwm_limit", 885, 442)


def test_a_refusal_names_register_and_rule() -> None:
    servos, _ = robot()
    servos.set_torque(True)
    with pytest.raises(Refused, match=r"hip_rr \(id 10\): refuses pwm_limit = 442: .*EEPROM is locked"):
        servos.write_counts("pwm_limit", "hip_rr", 442)


def test_an_alert_is_decoded_and_does_not_hide_the_answer() -> None:
    servos, line = robot()
    device = line.wire.servos[1]  # type: ignore[attr-defined]
    device.set("hardware_error_status", 0x04)
    answers = servos.read_blocks()
    assert answers[1][0].ok
    assert answers[1][0].word == "alert"
    assert answers[1][1] is not None
    [error] = servos.hardware_errors("knee_rr")
    assert error.name == "overheating"
    assert "cool" in error.advice


def test_torque_after_a_shutdown_says_why() -> None:
    servos, line = robot()
    device = line.wire.servos[1]  # type: ignore[attr-defined]
    device.set("hardware_error_status", 0x04)
    device.shut_down = True
    with pytest.raises(Refused, match=r"torque stays off after overheating → .*cool"):
        servos.set_torque(True)


def test_a_bus_that_nobody_guards_lets_no_servo_move_whatever_the_way() -> None:
    """calib ids and centre once switched torque on over a bare bus, and a kill left it on for good."""
    servos, line = robot()
    bus, first = servos.bus, servos.ids[0]
    bus.guarded = False
    on, goal = b"\1", (2300).to_bytes(4, "little")
    ways: list[Callable[[], object]] = [
        lambda: servos.set_torque(True),
        lambda: servos.write_counts("torque_enable", "hip_rr", 1),
        lambda: servos.write_all("torque_enable", {"hip_rr": 1}),
        lambda: servos.write_all("goal_position", {"hip_rr": 2300}),
        lambda: servos.write("goal_position", "hip_rr", 1.0),
        lambda: servos.write_goals([2300] * 8),
        lambda: bus.write(first, 64, on),
        lambda: bus.write(p2.BROADCAST, 63, b"\0\1"),
        lambda: bus.reg_write(first, 64, on),
        lambda: bus.sync_write(64, 1, {first: on}),
        lambda: bus.bulk_write([(first, 65, on), (servos.ids[1], 116, goal)]),
    ]
    for way in ways:
        with pytest.raises(BadInput, match=r"nobody would switch torque off .* through the engine"):
            way()
    for guarded in (False, True):
        bus.guarded = guarded
        with pytest.raises(BadInput, match="as it starts is guarded by nobody"):
            servos.write_counts("startup_configuration", "hip_rr", 1)
    assert not any(device.torque for device in line.wire.servos)  # type: ignore[attr-defined]
    bus.guarded = False
    servos.set_torque(False)
    servos.write_counts("led", "hip_rr", 1)
    bus.sync_write(112, 4, dict.fromkeys(servos.ids, bytes(4)))


def test_a_tripped_watchdog_is_found() -> None:
    servos, line = robot()
    servos.set_torque(True)
    for joint in JOINTS:
        servos.write_counts("bus_watchdog", joint, 10)
    line.sleep_until(line.now() + 1.0)  # type: ignore[attr-defined]
    assert servos.tripped_watchdogs() == list(JOINTS)
    with pytest.raises(Refused, match="Bus Watchdog has tripped"):
        servos.write_counts("goal_position", "hip_rr", 2000)
    servos.write_counts("bus_watchdog", "hip_rr", 0)
    servos.write_counts("goal_position", "hip_rr", 2000)


def test_a_servo_of_another_model_is_told() -> None:
    bus, _ = ant()
    servos = Servos(bus, [Servo("hip_rr", 10, kit("standard").servo("knee"))])
    with pytest.raises(HardwareFault, match="is a XC430-W240-T, not a XM430-W350-T"):
        servos.identify()


def test_identify_knows_who_can_be_read_fast() -> None:
    servos, _ = robot()
    servos.identify()
    assert servos.bus.fast == set(IDS)
    servos, _ = robot(firmware=42)
    servos.identify()
    assert not servos.bus.fast


def test_goals_and_angles_are_inverse() -> None:
    servos, _ = robot()
    angles = [0.1, -0.2, 0.3, -0.4, 0.5, -0.6, 0.7, -0.8]
    assert servos.joint_rad(servos.goal_counts(angles)) == pytest.approx(angles, abs=p2_step())
    servos.set_torque(True)
    servos.write_goals(servos.goal_counts(angles))
    counts = [block.position for _, block in servos.read_blocks() if block]
    assert servos.joint_rad(counts) == pytest.approx(angles, abs=p2_step())


def p2_step() -> float:
    return 2 * 3.14159265 / 4096 / 2 + 1e-9


def test_a_servo_whose_joint_nobody_knows_is_called_by_its_id_once() -> None:
    bus, line = ant()
    line.wire.settings.lost[IDS.index(31)] = 1.0
    Servos(bus, [Servo("id 31", 31, kit("standard").servo("knee")), Servo("hip_fl", 30, kit("standard").servo("hip"))])
    with pytest.raises(NoAnswer, match=r"\bid 31 does not answer"):
        bus.read(31, 132, 4)
    line.wire.settings.lost[IDS.index(30)] = 1.0
    with pytest.raises(NoAnswer, match=r"hip_fl \(id 30\) does not answer"):
        bus.read(30, 132, 4)


def test_emergency_packet_releases_everyone() -> None:
    servos, line = robot()
    servos.set_torque(True)
    servos.torque_off_now()
    assert not any(device.torque for device in line.wire.servos)  # type: ignore[attr-defined]


def test_torque_off_gets_through_a_line_that_breaks_every_tenth_byte() -> None:
    released = 0
    for seed in range(50):
        bus, line = ant(settings=BusSettings(), seed=seed)
        servos = Servos(bus, [Servo(j.name, j.id, kit("standard").servo(j.kind)) for j in JOINTS.values()])
        servos.set_torque(True)
        line.wire.settings.byte_error = 0.1
        servos.torque_off_now()
        released += not any(device.torque for device in line.wire.servos)
    assert released > 35
