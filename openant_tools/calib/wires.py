"""The bench's ports, opened for one step and left with torque off."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.bus import Bus
from openant_tools.comms.clock import Clock, RealClock, SteppedClock, VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.guards import Guards
from openant_tools.comms.imu import Imu, open_imu
from openant_tools.comms.line import SerialLine
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.protocol2 import BROADCAST, write
from openant_tools.comms.servos import Servo, Servos
from openant_tools.comms.setup import config_of_robot, find_bus, imu_of_robot, open_bus
from openant_tools.comms.silence import explaining
from openant_tools.comms.state import passport_registers
from openant_tools.errors import HardwareFault
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.procedure.step import Bench, Say, Subroutine
from openant_tools.robot.config import MotorSection, RobotConfig
from openant_tools.robot.registers import RAD_PER_PULSE

__all__ = [
    "BOOT_S", "SETTLE_S", "bare_config", "clock_of", "differs", "engine_config", "heard", "in_joints", "journalled", "opened_bus", "opened_imu", "rest", "robot_servos", "servo_angles", "wait",
]  # fmt: skip

Array = NDArray[np.float64]

#: s from power to the first answer of a servo, with a margin; and for a leg or a body to come to rest after hands.
BOOT_S = 0.8
SETTLE_S = 1.5
#: Broadcasts of torque off when a port is given back.
RELEASES = 3


@contextlib.contextmanager
def opened_bus(bench: Bench, baud: int | None = None) -> Iterator[Bus]:
    """The bus at its own rate, or at `baud`, to ask and to write memory: torque comes from an engine alone.

    However the block is left, every servo at the rate it is left with is released.
    """
    config = bench.folder.config()
    bus = open_bus(find_bus(bench.bus, config), baud or config.bus.baud, bench.control)
    bus.timing = replace(bus.timing, write_read_gap_s=config.bus.write_read_gap_s, return_delay_s=508e-6)
    try:
        with explaining(bus, config.bus.chain):
            yield bus
    finally:
        with contextlib.suppress(HardwareFault):  # the port may be what has gone
            for _ in range(RELEASES):
                bus.send(write(BROADCAST, 64, b"\0").encode())
            wait(bus.clock, 0.01)
        bus.close()


@contextlib.contextmanager
def opened_imu(bench: Bench) -> Iterator[tuple[Imu, Clock]]:
    """The flight controller, connected, and the clock that it lives by.

    Raises:
        HardwareFault: nobody has named its port, or it does not answer as one.
    """
    named = imu_of_robot(bench.folder.config(), bench.imu)
    if named is None:
        raise HardwareFault(
            "no flight controller is known", remedy="plug it in and run `openant calib connect`, or name it with --imu"
        )
    clock: Clock = RealClock()
    imu: Imu | None = None
    if bench.control:
        remote = VirtualControl(bench.control)
        if remote.ask("now")["stepped"]:
            stepped = SteppedClock(remote)

            def attached() -> SerialLine:
                line = SerialLine(named.port, 115_200)
                stepped.attach(imu=line)
                return line

            imu = Imu(
                attached, stepped, where=named.port,
                gyro_counts_per_dps=named.gyro_counts_per_dps, acc_counts_per_g=named.acc_counts_per_g,
            )  # fmt: skip
            imu.connect()
            clock = stepped
    if imu is None:
        imu = open_imu(
            named.port, clock, gyro_counts_per_dps=named.gyro_counts_per_dps, acc_counts_per_g=named.acc_counts_per_g
        )
    try:
        yield imu, clock
    finally:
        imu.close()


def clock_of(bench: Bench) -> Clock:
    """The time by which the bench lives, where nothing is opened that brings its own."""
    if bench.control is not None:
        remote = VirtualControl(bench.control)
        if remote.ask("now")["stepped"]:
            return SteppedClock(remote)
    return RealClock()


def journalled(bus: Bus, servos: Sequence[Servo], bench: Bench, command: str) -> Servos:
    """Servos whose every EEPROM write stands in the robot's journal before it is sent."""
    journal = Journal(bench.folder.journal)

    def note(change: EepromWrite) -> None:
        journal.append(change, command)

    return Servos(bus, servos, before_write=note)


def robot_servos(config: RobotConfig, joints: Sequence[str] = ()) -> list[Servo]:
    """The servos as robot.toml describes them, all or those of `joints`."""
    return [_servo(motor) for motor in config.motors.values() if not joints or motor.joint in joints]


def _servo(motor: MotorSection) -> Servo:
    return Servo(motor.joint, motor.id, motor.servo, motor.direction, motor.zero_offset_rad)


def engine_config(bench: Bench, **more: object) -> EngineConfig:
    """The engine's config for this robot, its IMU beside the bus where it is known."""
    config = bench.folder.config()
    passport = passport_registers(bench.folder, real=not bench.virtual)
    more = {"imu": imu_of_robot(config, bench.imu), "journal": str(bench.folder.journal), "passport": passport, **more}
    return config_of_robot(config, bench.bus, control=bench.control, **more)


def bare_config(bench: Bench, servos: Sequence[Servo], baud: int) -> EngineConfig:
    """The engine's config for servos as they come, each within its one turn, with its angle told from its own zero."""
    return EngineConfig(
        port=find_bus(bench.bus, bench.folder.config()),
        servos=tuple(servos),
        baud=baud,
        control=bench.control,
        # A servo may lie anywhere, and hands may turn it while it is limp.
        guards=Guards(angle_margin_rad=None),
        limits_rad={servo.joint: _one_turn(servo) for servo in servos},
        # What is set in them is looked at when they have their ids.
        anyway=True,
        journal=str(bench.folder.journal),
    )


def _one_turn(servo: Servo) -> tuple[float, float]:
    """rad: the ends of a servo's one turn, at the joint."""
    low, high = sorted(servo.to_joint(end) for end in (0.0, 2 * math.pi - RAD_PER_PULSE))
    return low, high


def differs(bus: Bus, motor: MotorSection) -> str:
    """What of a servo does not read as robot.toml has it: silent, or another model; "" where it is that joint's."""
    found = bus.ping(motor.id, insist=True)
    if found is None:
        return f"nothing answers under id {motor.id}"
    if found.model_number != motor.servo.number:
        return f"the model number under id {motor.id} is {found.model_number}, not {motor.servo.number}"
    return ""


def heard(engine: EngineProcess) -> Subroutine[None]:
    """Say what the engine found worth knowing; raises HardwareFault where it switched torque off, with the guard's own words."""
    for event in engine.events():
        if isinstance(event, messages.Notice):
            yield Say(event.text)
        elif isinstance(event, messages.Stopped):
            raise HardwareFault(event.what, where=engine.config.port, remedy=event.remedy)


def rest(bench: Bench) -> None:
    """Let a robot that hands have put somewhere come to rest, and its servos start, torque off."""
    with opened_bus(bench) as bus:
        wait(bus.clock, BOOT_S + SETTLE_S)


def wait(clock: Clock, seconds: float) -> None:
    clock.sleep_until(clock.now() + seconds)


def servo_angles(servos: Servos, readings: int = 1, pause_s: float = 0.01) -> Array:
    """(readings, n) rad in each servo's own frame.

    Raises:
        NoAnswer: one is silent; the message names it.
    """
    rows = []
    for k in range(readings):
        if k:
            wait(servos.bus.clock, pause_s)
        counts = servos.read_all("present_position")
        rows.append([counts[s.joint] * s.model.registers["present_position"].scale for s in servos.servos])
    return np.array(rows)


def in_joints(servos: Servos, row: Array) -> dict[str, float]:
    """joint → its angle, rad within half a turn, of one row (n,) in the servos' own frames."""
    angles = (servo.to_joint(float(angle)) for servo, angle in zip(servos.servos, row, strict=True))
    return {
        s.joint: (angle + math.pi) % (2 * math.pi) - math.pi for s, angle in zip(servos.servos, angles, strict=True)
    }
