"""The servos of a robot by joint and register name, in SI units, on top of a bus.

Joint angles follow one convention: joint = direction · (servo − zero), with the servo's own angle counted from its
register's zero. Everything else is in the servo's own frame, as its registers hold it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from openant_tools.comms.bus import FAST_READ_FIRMWARE, Answer, Bus, FoundServo, called
from openant_tools.comms.faults import BrokenAnswer, Cause, Refused
from openant_tools.comms.protocol2 import BROADCAST, SyncWriteTemplate, write
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.procedure.journal import EepromWrite
from openant_tools.robot.registers import EEPROM_END, Register
from openant_tools.robot.servo import HardwareError, ServoModel, baud_code, hardware_errors, servo_model

__all__ = ["BLOCK", "BLOCK_ADDRESS", "BLOCK_SIZE", "Block", "Servo", "Servos"]

#: Registers 120…146 in one read: tick, moving, moving status, PWM, current or load, velocity, position, velocity and
#: position trajectory, voltage, temperature.
BLOCK_ADDRESS = 120
BLOCK_SIZE = 27
BLOCK = struct.Struct("<HBBhhiiiiHB")
#: A clear of the watchdog and its trip value (register 98).
WATCHDOG_TRIPPED = -1
#: Pairs of readings of one register, of which one must agree.
CONFIRMATIONS = 3
#: Broadcasts of torque off: where one byte in ten breaks, one of 13 bytes arrives in four times.
RELEASES = 6


class Block(NamedTuple):
    """Registers 120…146 of one servo, in counts."""

    tick: int
    moving: int
    moving_status: int
    pwm: int
    effort: int
    velocity: int
    position: int
    velocity_trajectory: int
    position_trajectory: int
    voltage: int
    temperature: int


@dataclass(frozen=True)
class Servo:
    """One servo of the robot: who it is, and how its angle is its joint's.

    Attributes:
        direction: +1 or −1; joint = direction · (servo − zero).
        zero_rad: servo angle at the joint's zero.
    """

    joint: str
    id: int
    model: ServoModel
    direction: int = 1
    zero_rad: float = 0.0
    firmware: int | None = None

    @property
    def called(self) -> str:
        """Joint and id, for messages."""
        return called(self.joint, self.id)

    def to_joint(self, servo_rad: float) -> float:
        return self.direction * (servo_rad - self.zero_rad)

    def to_servo(self, joint_rad: float) -> float:
        return self.direction * joint_rad + self.zero_rad


@dataclass
class Servos:
    """The servos of one bus.

    Attributes:
        journal: every EEPROM write done through this object, in order; the caller keeps it.
        before_write: called before each of them is sent; raising keeps it from being sent.
    """

    bus: Bus
    servos: Sequence[Servo]
    journal: list[EepromWrite] = field(default_factory=list)
    before_write: Callable[[EepromWrite], None] | None = None

    def __post_init__(self) -> None:
        self._by_joint = {servo.joint: servo for servo in self.servos}
        self.ids = tuple(servo.id for servo in self.servos)
        self._goals = SyncWriteTemplate(116, "i", self.ids)
        if len(set(self.ids)) != len(self.ids):
            raise BadInput(
                f"two servos share an id: {', '.join(map(str, sorted(self.ids)))}",
                remedy="give each servo an id of its own",
            )
        self.bus.names = {servo.id: servo.joint for servo in self.servos}

    def __getitem__(self, joint: str) -> Servo:
        try:
            return self._by_joint[joint]
        except KeyError:
            raise BadInput(f"no joint {joint!r}", remedy=f"the joints are {', '.join(self._by_joint)}") from None

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self._by_joint)

    # ---- who is there --------------------------------------------------------------------------------------------

    def identify(self) -> dict[str, FoundServo]:
        """Ping every servo; joint → what answered.

        Raises:
            NoAnswer: some are silent; the message names the cable.
            HardwareFault: one is of another model than expected.
        """
        found: dict[str, FoundServo] = {}
        answers: list[Answer] = []
        for servo in self.servos:
            seen = self.bus.ping(servo.id, insist=True)
            answers.append(Answer(servo.id, b"" if seen else None, 0, None if seen else Cause.TIMEOUT))
            if seen:
                found[servo.joint] = seen
        self.bus.require(answers)
        for servo in self.servos:
            seen = found[servo.joint]
            if seen.model_number != servo.model.number:
                raise HardwareFault(
                    f"{servo.called} is a {_model_name(seen.model_number)}, not a {servo.model.name}",
                    where=self.bus.line.path,
                    remedy="correct its model in robot.toml, or the id of the servo: two may be swapped",
                )
        self.bus.fast = {servo.id for servo in self.servos if found[servo.joint].firmware >= FAST_READ_FIRMWARE}
        return found

    # ---- registers by name ---------------------------------------------------------------------------------------

    def read_counts(self, register: str, joint: str) -> int:
        servo, item = self._item(register, joint)
        return item.decode(self.bus.read(servo.id, item.address, item.size))

    def read(self, register: str, joint: str) -> float:
        """A register in its SI unit, in the servo's own frame."""
        return float(self._item(register, joint)[1].to_si(self.read_counts(register, joint)))

    def confirmed_counts(self, register: str, joint: str) -> int:
        """As `read_counts`, for what is written down or acted upon: read twice, in two ways, until both agree.

        The second reading has another length, so that no answer can serve both; where nothing stands beside the register,
        it waits until no answer to the first can come any more.

        Raises:
            BrokenAnswer: they go on disagreeing.
        """
        servo, item = self._item(register, joint)
        beside = _beside(servo, item)
        seen: list[int] = []
        for _ in range(CONFIRMATIONS):
            seen.append(item.decode(self.bus.read(servo.id, item.address, item.size)))
            if beside is None:
                self.bus.settle()
                seen.append(item.decode(self.bus.read(servo.id, item.address, item.size)))
            else:
                start, size = min(item.address, beside.address), item.size + beside.size
                data = self.bus.read(servo.id, start, size)
                seen.append(item.decode(data[item.address - start :][: item.size]))
            if seen[-1] == seen[-2]:
                return seen[-1]
        raise BrokenAnswer(
            f"{register} of {servo.called} reads {', '.join(map(str, dict.fromkeys(seen)))} by turns",
            where=self.bus.line.path,
            remedy="the line is not to be trusted: look at `openant comms watch` before anything is written",
        )

    def read_all(self, register: str, joints: Iterable[str] | None = None) -> dict[str, int]:
        """A register of many joints, joint → counts, by one sync read where its address is the same everywhere."""
        wanted = [self[joint] for joint in (self.joints if joints is None else joints)]
        items = {servo.joint: servo.model.register(register) for servo in wanted}
        first = next(iter(items.values()))
        answers = self.bus.sync_read(first.address, first.size, [servo.id for servo in wanted])
        values: dict[str, int] = {}
        for servo, answer in zip(wanted, answers, strict=True):
            if answer.data is not None and len(answer.data) == first.size and not answer.refusal:
                values[servo.joint] = items[servo.joint].decode(answer.data)
            else:
                values[servo.joint] = self.read_counts(register, servo.joint)  # alone, retried and counted
        return values

    def write(self, register: str, joint: str, value: float) -> None:
        """Set a register in its SI unit; see `write_counts`."""
        self.write_counts(register, joint, self._item(register, joint)[1].to_counts(value))

    def write_counts(self, register: str, joint: str, counts: int) -> None:
        """Set a register and prove it.

        EEPROM is written only where the value differs, is read back, and stands in `journal`.

        Raises:
            BadInput: no such register, not writable, or out of its range.
            Refused: the servo says no; the message names register and rule.
            HardwareFault: it reads back as something else.
        """
        servo, item = self._item(register, joint)
        if not item.writable:
            raise BadInput(f"{register} of {joint} cannot be written")
        item.check(counts)
        old = None
        if item.address < EEPROM_END:
            old = self.confirmed_counts(register, joint)
            if old == counts:
                return
            change = EepromWrite(joint, servo.id, register, old, counts, self.bus.line.baud, confirmed=True)
            if self.before_write is not None:
                self.before_write(change)
        data = item.encode(counts)
        try:
            self.bus.write(servo.id, item.address, data, f"{register} = {counts}")
        except Refused as refusal:
            raise self._explained(refusal, servo) from None
        if old is not None:
            self.journal.append(change)
            now = item.decode(self.bus.read(change.id_after, item.address, item.size))
            if now != counts:
                raise HardwareFault(
                    f"{register} of {servo.called} reads back {now} after writing {counts}",
                    where=self.bus.line.path,
                    remedy="write it again; a servo that forgets its memory must be replaced",
                )

    def write_baud(self, joint: str, baud: int) -> None:
        """Set a servo's baud rate and follow it there: the line is at the new rate when this returns.

        Raises:
            HardwareFault: it does not answer at the new rate; the line is back at the old one.
        """
        servo, item = self._item("baud_rate", joint)
        old, before = self.confirmed_counts("baud_rate", joint), self.bus.line.baud
        change = EepromWrite(joint, servo.id, "baud_rate", old, baud_code(baud), before, confirmed=True)
        if change.old != change.new:
            if self.before_write is not None:
                self.before_write(change)
            self.bus.write(servo.id, item.address, item.encode(change.new), f"baud_rate = {change.new}")
            self.journal.append(change)
        self.bus.line.set_baud(baud)
        if self.bus.ping(servo.id, insist=True) is None or self.read_counts("baud_rate", joint) != change.new:
            self.bus.line.set_baud(before)
            raise HardwareFault(
                f"{servo.called} does not answer at {baud} baud after it was set from {before}",
                where=self.bus.line.path,
                remedy="`openant calib ids` looks at every baud rate",
            )

    def write_all(self, register: str, counts: Mapping[str, int]) -> float:
        """A RAM register of many joints by one sync write, unanswered; the time its last byte has left (s)."""
        items = [(self[joint], self[joint].model.register(register), value) for joint, value in counts.items()]
        for _, item, value in items:
            item.check(value)
        first = items[0][1]
        data = {servo.id: item.encode(value) for servo, item, value in items}
        return self.bus.sync_write(first.address, first.size, data)

    def _item(self, register: str, joint: str) -> tuple[Servo, Register]:
        servo = self[joint]
        return servo, servo.model.register(register)

    def _explained(self, refusal: Refused, servo: Servo) -> Refused:
        """A refusal may be the watchdog's lock: say so only where it is."""
        if refusal.code == 4 and "bus_watchdog" in servo.model.registers:
            try:
                tripped = self.read_counts("bus_watchdog", servo.joint) == WATCHDOG_TRIPPED
            except HardwareFault:
                tripped = False
            if tripped:
                return Refused(
                    refusal.id, refusal.code, "its Bus Watchdog has tripped and locked the goals",
                    where=refusal.where, remedy="connect again: that reports and clears it",
                )  # fmt: skip
        return refusal

    # ---- every cycle ---------------------------------------------------------------------------------------------

    def read_blocks(self) -> list[tuple[Answer, Block | None]]:
        """Registers 120…146 of every servo, in order, in one request."""
        answers = self.bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, self.ids)
        return [
            (answer, Block._make(BLOCK.unpack(answer.data)) if answer.data and len(answer.data) == BLOCK_SIZE else None)
            for answer in answers
        ]

    def goal_counts(self, joint_rad: Sequence[float]) -> list[int]:
        """Goal positions in counts for joint angles (rad), in the order of `servos`."""
        return [
            round(servo.to_servo(angle) / servo.model.registers["goal_position"].scale)
            for servo, angle in zip(self.servos, joint_rad, strict=True)
        ]

    def joint_rad(self, counts: Sequence[int]) -> list[float]:
        """Joint angles (rad) of position counts."""
        return [
            servo.to_joint(count * servo.model.registers["present_position"].scale)
            for servo, count in zip(self.servos, counts, strict=True)
        ]

    def write_goals(self, counts: Sequence[int]) -> float:
        """Goal positions of all servos in counts; the time the last byte has left (s)."""
        if not self.bus.guarded:
            self.bus.check_guarded(116, bytes(4))
        return self.bus.send(self._goals.encode(counts))

    # ---- torque, watchdog, errors --------------------------------------------------------------------------------

    def set_torque(self, on: bool, joints: Iterable[str] | None = None) -> None:
        """Torque of these joints (default all), each proven by its answer."""
        for joint in self.joints if joints is None else joints:
            servo = self[joint]
            try:
                self.bus.write(servo.id, 64, bytes((on,)), "torque on" if on else "torque off")
            except Refused as refusal:
                errors = self.hardware_errors(joint)
                if not errors:
                    raise
                raise Refused(
                    servo.id, refusal.code, f"torque stays off after {errors[0].name}",
                    where=refusal.where, remedy=errors[0].advice,
                ) from None  # fmt: skip

    def torque_off_now(self) -> None:
        """Release every servo without waiting for a word: the emergency way.

        On a noisy line a packet arrives the sooner the shorter it is: a broadcast write follows, again and again.
        """
        self.bus.sync_write(64, 1, dict.fromkeys(self.ids, b"\0"))
        for _ in range(RELEASES):
            self.bus.send(write(BROADCAST, 64, b"\0").encode())
        self.bus.clock.sleep_until(self.bus.clock.now())  # a robot whose time waits for us hears it before anybody else

    def still_on(self, joints: Sequence[str]) -> list[str]:
        """Those of `joints` that do not say that their torque is off: on, or silent. Never raises for a silent one."""
        ids = [self[joint].id for joint in joints]
        answers = self.bus.sync_read(64, 1, ids, again=True)  # asked between two orders to let go: it must not wait
        return [joint for joint, answer in zip(joints, answers, strict=True) if answer.data != b"\0"]

    def hardware_errors(self, joint: str) -> tuple[HardwareError, ...]:
        """What stands in Hardware Error Status (70), decoded."""
        return hardware_errors(self.read_counts("hardware_error_status", joint))

    def tripped_watchdogs(self) -> list[str]:
        """Joints whose Bus Watchdog has tripped: their goals are locked and torque is still on."""
        able = [servo.joint for servo in self.servos if (servo.firmware or 99) >= 38]
        return [joint for joint, value in self.read_all("bus_watchdog", able).items() if value == WATCHDOG_TRIPPED]


def _beside(servo: Servo, item: Register) -> Register | None:
    """A register that can be read together with this one: next to it, in the same memory, in this firmware."""
    able = [
        r for r in servo.model.registers.values() if r.area == item.area and r.min_firmware <= (servo.firmware or 0)
    ]
    return next((other for other in able if other.address == item.end or other.end == item.address), None)


def _model_name(number: int) -> str:
    try:
        return servo_model(number).name
    except BadInput:
        return f"servo of model number {number}"
