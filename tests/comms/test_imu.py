"""The IMU driver against the virtual flight controller: in stepped time, and over a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.comms import msp
from openant_tools.comms.clock import RealClock
from openant_tools.comms.imu import IMU_BAUD, Imu, open_imu
from openant_tools.comms.line import PortGone, SerialLine
from openant_tools.errors import HardwareFault
from openant_tools.virtual.flight_controller import FlightController, FlightControllerSettings, rotation_from_rpy

GRAVITY = 9.80665


@dataclass
class Body:
    """A body that lies still unless told otherwise."""

    quaternion: np.ndarray = field(default_factory=lambda: np.array([1.0, 0, 0, 0]))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    specific_force: np.ndarray = field(default_factory=lambda: np.array([0.0, 0, GRAVITY]))


def turning(rate: float, t: float) -> Body:
    """A body that turns about its vertical, rad/s."""
    return Body(np.array([math.cos(rate * t / 2), 0, 0, math.sin(rate * t / 2)]), np.array([0, 0, rate]))


class Bench:
    """A flight controller on a table: its clock moves only while somebody waits, its cable is a pair of lists."""

    def __init__(self, settings: FlightControllerSettings | None = None, seed: int = 1) -> None:
        settings = settings or FlightControllerSettings()
        self.body = Body()
        self.motion: Callable[[float], Body] | None = None
        self.fc = FlightController(settings, lambda: self.body, np.random.default_rng(seed))
        self.t = 0.0
        self.stepped = False  # whether it tells the driver when bytes arrived, as a virtual robot's clock does
        self.marks: list[tuple[int, float]] = []
        self.lines: list[Cable] = []
        self.garble: Callable[[bytes], bytes] = lambda data: data

    def now(self) -> float:
        return self.t

    def sleep_until(self, t: float) -> None:
        while self.t < t:
            self.step(t)

    def wait_readable(self, line: Cable, deadline: float) -> bool:
        self.step(self.t)
        while not line.waiting and self.t < deadline and line.alive:
            self.step(deadline)
        return bool(line.waiting) or not line.alive

    def arrivals(self, line: Cable) -> list[tuple[int, float]]:
        return [self.marks[-1]] if self.stepped and self.marks else [(line.received, self.t)]

    def in_time(self, at: float, deadline: float) -> bool:
        return at <= deadline

    def step(self, limit: float) -> None:
        self.t = min(limit, max(self.t + 1e-5, self.fc.next_event(self.t)))
        if self.motion is not None:
            self.body = self.motion(self.t)
        data = self.garble(self.fc.transmit(self.t))
        for line in self.lines:
            if data:
                self.marks.append((line.received + len(line.waiting) + len(data), self.t))
            line.waiting += data
            line.alive = line.alive and self.fc.connected

    def open(self) -> Cable:
        self.step(self.t)
        if not self.fc.connected:
            raise HardwareFault("no such port", where="bench")
        self.lines = [Cable(self)]
        return self.lines[0]

    def imu(self) -> Imu:
        return Imu(self.open, self, where="bench")


class Cable:
    path, baud = "bench", IMU_BAUD

    def __init__(self, bench: Bench) -> None:
        self.bench, self.waiting, self.alive = bench, b"", True
        self.written = self.received = 0

    def fileno(self) -> int:
        raise OSError(errno.EBADF, "no file")

    def set_baud(self, baud: int) -> None: ...

    def close(self) -> None:
        self.alive = False

    def write(self, data: bytes) -> None:
        if not self.alive:
            raise PortGone(self.path)
        self.written += len(data)
        self.bench.fc.receive(data, self.bench.t)

    def read(self) -> bytes:
        if not self.alive and not self.waiting:
            raise PortGone(self.path)
        data, self.waiting = self.waiting, b""
        self.received += len(data)
        return data


def collect(bench: Bench, imu: Imu, seconds: float, every: float = 0.002) -> list:
    samples, end = [], bench.t + seconds
    while bench.t < end:
        sample = imu.service()
        if sample is not None:
            samples.append(sample)
        bench.sleep_until(bench.t + every)
    return samples


@pytest.mark.parametrize(
    ("minor", "sensor", "expected"),
    [(45, 2048, 512), (46, 2048, 2048), (46, 1024, 1024), (47, 4096, 4096), (48, 2048, 2048)],
)
def test_every_firmware_reads_one_g_at_rest(minor: int, sensor: int, expected: int) -> None:
    bench = Bench(FlightControllerSettings(api_minor=minor, acc_lsb_per_g=sensor))
    imu = bench.imu()
    info = imu.connect()
    assert info.acc_lsb_per_g == expected
    assert info.gravity == pytest.approx(GRAVITY, rel=0.01)
    assert info.polling == "multiple"
    assert info.notes == ()
    sample = imu.read(bench.t + 1.0)
    assert np.allclose(sample.acc, [0, 0, GRAVITY], atol=0.2)
    assert np.allclose(sample.gyro, 0, atol=0.02)
    assert sample.mag is None
    assert sample.yaw_step == (0.0 if minor == 48 else pytest.approx(math.radians(1)))


def test_the_platforms_own_scales_read_one_g_from_the_default_board() -> None:
    """Its releases divide by 512, its later code by what it has for the board's name; any other name it refuses."""
    by_board = {"KAKUTEH7MINI": 512.0, "TBS_LUCID_FC": 2048.0}
    bench = Bench()

    def ask(command: msp.Command) -> bytes:
        bench.fc.receive(msp.encode(msp.MspFrame(msp.Direction.REQUEST, command)), bench.t)
        bench.t += 0.1
        return msp.MspParser().feed(bench.fc.transmit(bench.t))[0].payload

    board = msp.BoardInfo.decode(ask(msp.Command.BOARD_INFO)).board
    z = msp.RawImu.decode(ask(msp.Command.RAW_IMU)).acc[2]
    assert z / by_board[board] * 9.81 == pytest.approx(9.81, rel=0.02)
    assert z / 512.0 * 9.81 == pytest.approx(9.81, rel=0.02)


def test_a_scale_that_the_firmware_does_not_promise_is_decided_by_gravity_and_said() -> None:
    class Patched(FlightControllerSettings):
        lsb_per_g = 512  # a vendor's build that kept the old division

    bench = Bench(Patched(api_minor=46))
    info = bench.imu().connect()
    assert info.acc_lsb_per_g == 512
    assert "Gravity says 512 LSB/g where API 1.46 promises 2048 or 1024 or 4096; gravity decides." in info.notes


def test_a_moving_robot_leaves_the_scale_to_the_firmware_and_says_so() -> None:
    bench = Bench()
    bench.motion = lambda t: Body(rate=np.array([0, 0, 2 * math.sin(9 * t)]))
    info = bench.imu().connect()
    assert (info.acc_lsb_per_g, info.gravity, info.gyro_bias) == (512, None, None)
    assert "moved while connecting" in info.notes[0]


def test_an_accelerometer_that_is_far_off_one_g_is_refused() -> None:
    bench = Bench(FlightControllerSettings(acc_scale=(1.0, 1.0, 0.7)))
    with pytest.raises(HardwareFault, match=r"1 g in no known scale .* calibrate the accelerometer"):
        bench.imu().connect()


def test_a_robot_that_comes_to_rest_while_connecting_is_waited_for() -> None:
    bench = Bench()
    bench.motion = lambda t: Body(rate=np.array([0, 0, 2.0 if t < 0.6 else 0.0]))
    info = bench.imu().connect()
    assert info.gravity == pytest.approx(GRAVITY, rel=0.01)
    assert info.notes == ()


def test_the_gyro_bias_at_rest_is_found() -> None:
    bench = Bench(FlightControllerSettings(gyro_bias=(0.02, -0.01, 0.03)))
    info = bench.imu().connect()
    assert info.gyro_bias == pytest.approx((0.02, -0.01, 0.03), abs=2e-3)


@pytest.mark.parametrize(("rate", "multiple", "expected"), [(100, True, 100), (100, False, 50), (500, True, 500)])
def test_the_rate_is_what_the_serial_task_allows(rate: float, multiple: bool, expected: float) -> None:
    bench = Bench(FlightControllerSettings(rate_hz=rate, multiple_msp=multiple))
    imu = bench.imu()
    info = imu.connect()
    assert info.rate_hz == pytest.approx(expected, rel=0.05)
    assert info.polling == ("multiple" if multiple else "alternate")
    assert multiple or "does not bundle messages" in info.notes[0]
    collect(bench, imu, 2.0, every=0.0005)
    assert imu.statistics.rate_hz == pytest.approx(expected, rel=0.05)
    assert imu.statistics.timeouts == 0
    assert imu.last is not None
    assert imu.last.roll is not None


@pytest.mark.parametrize(("every", "stepped"), [(0.0005, False), (0.0037, False), (0.0083, False), (0.02, True)])
def test_the_time_stamp_is_when_the_body_moved_not_when_the_request_waited(every: float, stepped: bool) -> None:
    bench = Bench(FlightControllerSettings(gyro_noise=0.0))
    bench.stepped = stepped
    imu = bench.imu()
    imu.connect()
    bench.motion = lambda t: Body(rate=np.array([0.0, 0.0, 5 * math.sin(2 * math.pi * 1.5 * t)]))
    collect(bench, imu, 0.1)
    samples = collect(bench, imu, 3.0, every=every)
    t = np.array([s.t for s in samples])
    z = np.array([s.gyro[2] for s in samples])
    late = [float(np.sum((z - 5 * np.sin(2 * np.pi * 1.5 * (t - d))) ** 2)) for d in np.arange(-0.01, 0.01, 1e-4)]
    assert abs(np.arange(-0.01, 0.01, 1e-4)[int(np.argmin(late))]) < 0.7e-3
    assert np.median([s.round_trip for s in samples]) > 3e-3  # a midpoint would have been off by half of this
    worst = max(s.t_error for s in samples[1:])
    assert worst == 0.0 if stepped else worst <= every / 2 + 1e-4


def test_angles_have_our_signs_and_yaw_has_whole_degrees() -> None:
    bench = Bench()
    imu = bench.imu()
    rpy = np.deg2rad([10.0, -20.0, 0.0])
    bench.body = Body(specific_force=rotation_from_rpy(*rpy).T @ [0, 0, GRAVITY])
    imu.connect()
    sample = imu.read(bench.t + 1)
    assert sample.roll == pytest.approx(rpy[0], abs=0.01)
    assert sample.pitch == pytest.approx(rpy[1], abs=0.01)
    # A slow turn to the left on the level: yaw grows, in steps of a degree.
    bench.body = Body()
    bench.sleep_until(bench.t + 30)  # the filter levels
    start, begun = imu.read(bench.t + 1), bench.t
    bench.motion = lambda t: turning(0.5, t - begun)
    samples = collect(bench, imu, 2.0)
    turned = math.remainder(samples[-1].yaw - start.yaw, 2 * math.pi)
    assert turned == pytest.approx(1.0, abs=0.05)
    degrees = np.rad2deg([s.yaw for s in samples])
    assert np.allclose(degrees, np.rint(degrees))


def test_a_body_that_is_let_go_in_the_air_is_not_taken_to_lie_on_its_side() -> None:
    """Nothing but noise pulls at it at first."""
    bench = Bench()
    bench.motion = lambda t: Body(specific_force=np.array([0.0, 0, GRAVITY if t > 0.2 else 0.0]))
    imu = bench.imu()
    imu.connect()
    sample = collect(bench, imu, 1.0)[-1]
    assert sample.roll == pytest.approx(0.0, abs=0.02)
    assert sample.pitch == pytest.approx(0.0, abs=0.02)


def test_feet_that_chatter_do_not_lean_the_body() -> None:
    """Between two looks it is back where it was, however fast it turns when it is looked at."""
    bench = Bench()
    imu = bench.imu()
    imu.connect()
    bench.motion = lambda t: Body(rate=np.array([3.0, 0, 0]))
    assert collect(bench, imu, 2.0)[-1].roll == pytest.approx(0.0, abs=0.05)


def test_the_quaternion_of_new_firmware_is_not_rounded() -> None:
    bench = Bench(FlightControllerSettings(api_minor=48))
    imu = bench.imu()
    imu.connect()
    bench.motion = lambda t: turning(0.5, t)
    degrees = np.rad2deg([s.yaw for s in collect(bench, imu, 1.0)])
    assert len(set(degrees)) > 80


def test_the_mounting_rotation_and_bias_are_in_the_readings() -> None:
    mount = (0.1, -0.2, 1.5)
    settings = FlightControllerSettings(mount_rpy=mount, acc_bias=(0.1, 0.2, -0.3), acc_noise=0.0)
    bench = Bench(settings)
    imu = bench.imu()
    imu.connect()
    expected = rotation_from_rpy(*mount).T @ [0, 0, GRAVITY] + [0.1, 0.2, -0.3]
    assert np.allclose(imu.read(bench.t + 1).acc, expected, atol=0.01)


def test_the_magnetometer_is_there_only_where_the_board_has_one() -> None:
    bench = Bench(FlightControllerSettings(magnetometer=True))
    imu = bench.imu()
    assert imu.connect().has_magnetometer
    assert imu.read(bench.t + 1).mag != (0, 0, 0)


# --- what goes wrong ---------------------------------------------------------------------------------------------


def test_a_silent_controller_is_named_quickly() -> None:
    bench = Bench()
    bench.fc.silent = True
    with pytest.raises(HardwareFault, match=r"bench: the flight controller is silent .* close Betaflight Configurator"):
        bench.imu().connect()
    assert bench.t <= 1.0


def test_a_controller_that_falls_silent_is_missed_within_a_fifth_of_a_second_and_taken_back() -> None:
    bench = Bench()
    imu = bench.imu()
    imu.connect()
    collect(bench, imu, 0.5)
    assert imu.fault() is None
    bench.fc.silent = True
    collect(bench, imu, 0.3)
    assert "silent (for 0." in str(imu.fault())
    with pytest.raises(HardwareFault, match="silent"):
        imu.read(bench.t + 0.1)
    for _ in range(20):
        # Whether the port is just being closed, opened or asked: the board is silent, its cable is in.
        collect(bench, imu, 0.1)
        assert "silent" in str(imu.fault())
    bench.fc.silent = False
    assert collect(bench, imu, 1.5)
    assert imu.fault() is None
    assert imu.statistics.timeouts > 5


def test_an_unplugged_controller_comes_back_by_itself() -> None:
    bench = Bench()
    imu = bench.imu()
    imu.connect()
    collect(bench, imu, 0.2)
    bench.fc.unplug(bench.t)
    collect(bench, imu, 0.5)
    assert "unplugged" in str(imu.fault())
    bench.fc.plug(bench.t)
    samples = collect(bench, imu, 3.0)
    assert len(samples) > 80
    assert imu.statistics.reconnects == 1
    assert imu.fault() is None


def test_another_board_in_its_place_is_not_taken_for_it() -> None:
    bench = Bench()
    imu = bench.imu()
    imu.connect()
    bench.fc.unplug(bench.t)
    collect(bench, imu, 0.2)
    other = replace(bench.fc.settings, uid=(1, 2, 3), acc_lsb_per_g=1024)
    bench.fc = FlightController(other, lambda: bench.body, np.random.default_rng(0))
    assert collect(bench, imu, 2.0) == []
    assert "another flight controller (000000010000000200000003) answers" in str(imu.fault())


def test_a_sensor_that_hangs_is_noticed() -> None:
    bench = Bench()
    imu = bench.imu()
    imu.connect()
    collect(bench, imu, 0.3)
    bench.fc.frozen = True
    collect(bench, imu, 1.0)
    assert "has sent the same reading for" in str(imu.fault())


def test_a_lone_hash_opens_the_command_line_and_the_driver_says_so() -> None:
    bench = Bench()
    line = bench.open()
    line.write(b"#")
    bench.sleep_until(0.2)
    assert bench.fc.mode == "cli"
    with pytest.raises(HardwareFault, match=r"command line .CLI., where it answers no MSP .* type `exit`"):
        bench.imu().connect()
    bench.fc.receive(b"\rexit\r", bench.t)  # the first ends the line that the driver began
    bench.sleep_until(bench.t + 2.0)
    assert bench.imu().connect().variant == "BTFL"


def test_a_lone_r_is_the_end_until_the_next_power_cycle() -> None:
    bench = Bench()
    line = bench.open()
    line.write(b"R")
    bench.sleep_until(0.05)
    line.write(msp.request(1))  # a frame in time takes it back
    bench.sleep_until(0.3)
    assert bench.fc.mode == "msp"
    line.write(b"R")
    bench.sleep_until(0.5)
    assert bench.fc.mode == "bootloader"
    assert not bench.fc.connected
    with pytest.raises(HardwareFault, match="no such port"):
        bench.imu().connect()


def test_the_driver_never_sends_a_byte_outside_a_frame() -> None:
    bench = Bench(FlightControllerSettings(multiple_msp=False))
    sent: list[bytes] = []
    receive = bench.fc.receive
    bench.fc.receive = lambda data, t: (sent.append(data), receive(data, t))[1]  # type: ignore[method-assign]
    imu = bench.imu()
    imu.connect()
    bench.fc.silent = True
    collect(bench, imu, 2.0)
    for data in sent:  # one write is one whole frame
        assert len(msp.MspParser().feed(data)) == 1
        assert msp.encode(msp.MspParser().feed(data)[0]) == data


@settings(max_examples=60)
@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from([b"#", b"R", b"$M<", b"exit\r", msp.request(230)]))))
def test_any_bytes_leave_the_controller_answering_after_a_power_cycle(chunks: list[bytes]) -> None:
    bench = Bench()
    for chunk in chunks:
        bench.fc.receive(chunk, bench.t)
        bench.sleep_until(bench.t + 0.06)
    bench.fc.unplug(bench.t)
    bench.fc.plug(bench.t)
    bench.sleep_until(bench.t + 2.0)
    assert bench.imu().connect().variant == "BTFL"


def test_refused_messages_and_wrong_firmware_are_named() -> None:
    bench = Bench()
    bench.fc.refused = {msp.Command.BOARD_INFO}
    with pytest.raises(HardwareFault, match=r"does not answer BOARD_INFO \(4\)"):
        bench.imu().connect()
    bench.fc.refused = set()
    bench.garble = lambda data: data.replace(b"BTFL", b"LFTB")  # the XOR stays
    with pytest.raises(HardwareFault, match="runs 'LFTB', whose sensor scales are not known"):
        bench.imu().connect()


def test_the_bus_in_place_of_the_imu_is_told_apart() -> None:
    bench = Bench()
    bench.garble = lambda data: b"\xff\xff\xfd\x00\x01\x07\x00\x55" if data else b""
    with pytest.raises(HardwareFault, match="a Dynamixel servo answers here"):
        bench.imu().connect()
    bench.garble = lambda data: b"$GPGGA,1" if data else b""
    with pytest.raises(HardwareFault, match=r"no flight controller .it sent 24 47 50 47"):
        bench.imu().connect()


def test_noise_on_the_cable_costs_samples_and_never_makes_one_up() -> None:
    bench = Bench(FlightControllerSettings(gyro_noise=0.0, acc_noise=0.0))
    imu = bench.imu()
    imu.connect()
    good = imu.read(bench.t + 1)
    rng = np.random.default_rng(5)

    def flip(data: bytes) -> bytes:
        raw = bytearray(data)
        if raw and rng.random() < 0.5:
            raw[rng.integers(len(raw))] ^= int(rng.integers(1, 256))
        return bytes(raw)

    bench.garble = flip
    samples = collect(bench, imu, 5.0)
    assert 100 < len(samples) < 450
    for sample in samples:
        assert np.allclose(sample.acc, good.acc, atol=0.02)
        assert np.allclose(sample.gyro, good.gyro, atol=0.005)
    assert imu.statistics.timeouts > 20


def test_the_accelerometer_calibration_levels_the_reading() -> None:
    bench = Bench(FlightControllerSettings(acc_bias=(0.5, 0.0, 0.2), acc_calibrated=False))
    imu = bench.imu()
    info = imu.connect()
    assert "never calibrated" in info.notes[0]
    bench.fc.receive(msp.request(msp.Command.ACC_CALIBRATION), bench.t)
    collect(bench, imu, 2.0)
    assert np.allclose(np.mean([s.acc for s in collect(bench, imu, 1.0)], axis=0), [0, 0, GRAVITY], atol=0.02)


def test_board_alignment_takes_effect_after_storing_and_rebooting() -> None:
    bench = Bench(FlightControllerSettings(mount_rpy=(0, 0, math.pi / 2), acc_noise=0.0))
    bench.body = Body(specific_force=np.array([GRAVITY, 0, 0]))
    imu = bench.imu()
    imu.connect()
    assert np.allclose(imu.read(bench.t + 1).acc, [0, -GRAVITY, 0], atol=0.01)
    for command, payload in (
        (msp.Command.SET_BOARD_ALIGNMENT, msp.BoardAlignment(0, 0, 90).encode()),
        (msp.Command.EEPROM_WRITE, b""),
        (msp.Command.REBOOT, b""),
    ):
        bench.fc.receive(msp.request(command, payload), bench.t)
    collect(bench, imu, 3.0)
    assert np.allclose(imu.read(bench.t + 1).acc, [GRAVITY, 0, 0], atol=0.01)


# --- over a pseudo-terminal, in real time --------------------------------------------------------------------------


class Host(threading.Thread):
    """Carries bytes between a pseudo-terminal and a flight controller; pulls and puts back its cable."""

    def __init__(self, fc: FlightController, link: Path) -> None:
        super().__init__(daemon=True)
        self.fc, self.link, self.master = fc, link, -1
        self.orders: list[Callable[[float], None]] = []
        self.stop = threading.Event()
        self.plugged()

    def plugged(self) -> None:
        self.master, slave = os.openpty()
        os.set_blocking(self.master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        self.slave = slave

    def run(self) -> None:
        while not self.stop.wait(0.0005):
            now = time.monotonic()
            while self.orders:
                self.orders.pop()(now)
            data = self.fc.transmit(now)
            if self.master < 0 and self.fc.connected:
                self.plugged()
            elif self.master >= 0 and not self.fc.connected:
                os.close(self.slave)
                os.close(self.master)
                self.link.unlink()
                self.master = -1
            if self.master < 0:
                continue
            with contextlib.suppress(OSError):
                if data:
                    os.write(self.master, data)
                self.fc.receive(os.read(self.master, 4096), time.monotonic())


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Host]:
    settings = FlightControllerSettings(api_minor=45, rate_hz=500)
    host = Host(FlightController(settings, lambda: Body(), np.random.default_rng(3)), tmp_path / "imu")
    host.start()
    yield host
    host.stop.set()
    host.join()


def test_over_a_pseudo_terminal_it_connects_reads_and_survives_an_unplug(terminal: Host) -> None:
    imu = open_imu(str(terminal.link), RealClock())
    assert imu.info.acc_lsb_per_g == 512
    clock = RealClock()
    samples = [imu.read(clock.now() + 1.0) for _ in range(50)]
    assert np.allclose(np.mean([s.acc for s in samples], axis=0), [0, 0, GRAVITY], atol=0.05)
    assert np.all(np.diff([s.t for s in samples]) > 0)
    terminal.orders.append(terminal.fc.unplug)
    while imu.fault() is None:
        imu.service()
    assert "unplugged" in str(imu.fault())
    terminal.orders.append(terminal.fc.plug)
    imu.read(clock.now() + 10.0)
    assert imu.statistics.reconnects == 1
    imu.close()


def test_a_port_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(HardwareFault) as error:
        SerialLine(str(tmp_path / "none"), IMU_BAUD)
    assert str(tmp_path / "none") in str(error.value)
