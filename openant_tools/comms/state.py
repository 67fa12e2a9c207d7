"""What is set in a servo, against what should be: read, never assumed, since other software leaves things behind.

`SETTINGS` says of every register that decides how a servo moves or answers what it does to a motion. Comparing is a
function of data, so that the engine, the daily check and the inventory tell the same of the same servo. A value is
expected by whoever comes first: what we set ourselves, the robot's passport, `robot.toml`, the factory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from openant_tools.comms.servos import Servo, Servos
from openant_tools.numbers import number, percent
from openant_tools.procedure.finding import latest
from openant_tools.robot.registers import EEPROM_END, PULSES_PER_TURN, PWM_FULL
from openant_tools.robot.servo import ServoModel, hardware_errors

if TYPE_CHECKING:
    from openant_tools.robot.config import RobotConfig
    from openant_tools.robot.folder import RobotFolder

__all__ = [
    "BY_FACTORY", "BY_PASSPORT", "BY_ROBOT_TOML", "BY_US", "RECORDED", "SETTINGS", "Difference", "Expected", "Setting", "differences",
    "differences_of_robot", "expected", "factory", "of_robot_toml", "passport_registers", "read_state", "refusal", "stopping",
]  # fmt: skip

BY_US, BY_PASSPORT, BY_ROBOT_TOML, BY_FACTORY = "we set", "its passport has", "robot.toml has", "the factory's is"
BY_LIMIT = "its own"
#: The command that mends a difference, or takes it into the passport.
MENDED_BY = "`openant calib inventory`"

POSITION, EXTENDED_POSITION = 3, 4
#: Bits of the drive mode (e-manual).
REVERSED, TIME_BASED, TORQUE_BY_GOAL = 0x01, 0x04, 0x08
RESTORES_RAM = 0x02
#: A profile this much faster than the unloaded motor can turn changes nothing.
FASTER = 1.2
#: rad; a joint that gives way so far under the torque that it is made to bear for long does not hold a pose
SOFT_RAD = 0.5

#: Factory values of older firmware and manuals, which are as good (ROBOTIS e-manual).
FACTORY_BEFORE: Mapping[tuple[str, str], tuple[int, ...]] = {
    ("XL430-W250-T", "velocity_limit"): (415,),
    ("XM430-W350-T", "velocity_limit"): (350,),
    ("XL430-W250-T", "min_voltage_limit"): (65,),
    ("XC430-W240-T", "min_voltage_limit"): (65,),
}


@dataclass(frozen=True)
class SeenRegister:
    """One register as it was found, with what bears on it.

    Attributes:
        found: counts. table: all settings of this servo.
        limits_rad: of the joint's commands; None where nobody has said.
        ids: of all servos on this bus.
    """

    servo: Servo
    found: int
    table: Mapping[str, int]
    limits_rad: tuple[float, float] | None
    ids: frozenset[int]


def _never(seen: SeenRegister) -> bool:
    return False


@dataclass(frozen=True)
class Setting:
    """What one register does to a motion.

    Attributes:
        does: in words, of a value that was not expected.
        stops: whether such a value makes a motion wrong or unsafe, so that nothing may move before somebody has seen it.
        factory: whether the factory's value is expected where nobody says otherwise.
    """

    does: str | Callable[[SeenRegister], str]
    stops: Callable[[SeenRegister], bool] = _never
    factory: bool = True

    def words(self, seen: SeenRegister) -> str:
        return self.does if isinstance(self.does, str) else self.does(seen)


def _drive(seen: SeenRegister) -> str:
    words = [
        what
        for bit, what in (
            (REVERSED, "it turns the other way round"),
            (TIME_BASED, "its profiles count milliseconds"),
            (TORQUE_BY_GOAL, "a goal switches its torque on"),
        )
        if seen.found & bit
    ]
    return " and ".join(words) or "it turns the way it is mounted"


def _narrow(seen: SeenRegister) -> bool:
    """Whether the servo refuses a part of the commands that its joint may be given."""
    if seen.table.get("operating_mode", POSITION) != POSITION or seen.limits_rad is None:
        return False
    scale = seen.servo.model.register("goal_position").scale
    low, high = sorted(seen.servo.to_servo(angle) / scale for angle in seen.limits_rad)
    turns = math.floor((low + high) / 2 / PULSES_PER_TURN) * PULSES_PER_TURN
    least, most = seen.table.get("min_position_limit", 0), seen.table.get("max_position_limit", PULSES_PER_TURN - 1)
    # A range that reaches beyond the encoder's turn is moved to extended mode, where these limits are not in force.
    return max(low - turns, 0) < least or min(high - turns, PULSES_PER_TURN - 1) > most


def _limit(seen: SeenRegister) -> str:
    if seen.table.get("operating_mode", POSITION) != POSITION:
        return "not in force in extended position mode"
    return "it refuses goals beyond" + (", which this joint needs" if _narrow(seen) else "")


def _slow(seen: SeenRegister) -> bool:
    velocity, table = seen.table.get("profile_velocity", 0), seen.table
    if not velocity:
        return False  # without a velocity there is no profile, whatever the acceleration
    if table.get("drive_mode", 0) & TIME_BASED or table.get("profile_acceleration", 0):
        return True
    model = seen.servo.model
    return bool(model.register("profile_velocity").to_si(velocity) < FASTER * model.no_load_rad_s)


def _velocity(seen: SeenRegister) -> str:
    if not seen.found:
        return "it goes to its goals at once"
    if seen.table.get("drive_mode", 0) & TIME_BASED:
        return f"it takes {seen.found} ms to every goal"
    return f"it turns no faster than {_si(seen)}"


def _acceleration(seen: SeenRegister) -> str:
    if not seen.table.get("profile_velocity", 0):
        return "without effect while profile_velocity is 0"
    return "it is slow to start and to stop"


def _weak(seen: SeenRegister) -> bool:
    """Whether it may push less than what it is made to bear for long."""
    return seen.servo.model.stall_torque_at(duty=abs(seen.found) / PWM_FULL) < seen.servo.model.nominal_torque_nm


def _push(seen: SeenRegister) -> str:
    return f"it pushes with {percent(abs(seen.found) / PWM_FULL)} of full duty at most"


def _soft(seen: SeenRegister) -> bool:
    stiffness = seen.servo.model.stiffness_nm_rad(seen.found)
    return stiffness * SOFT_RAD < seen.servo.model.nominal_torque_nm


def _stiffness(seen: SeenRegister) -> str:
    default = seen.servo.model.register("position_p_gain").default or 1
    return f"it is {number(seen.found / default)} times as stiff as from the factory"


def _shadow(seen: SeenRegister) -> bool:
    return seen.found in seen.ids and seen.found != seen.servo.id


def _second(seen: SeenRegister) -> str:
    return f"it obeys what is told to id {seen.found}, too" if seen.found < 253 else "it obeys its own id alone"


def _shutdown(seen: SeenRegister) -> str:
    default = seen.servo.model.register("shutdown").default or 0
    names = [error.name for error in hardware_errors(default & ~seen.found)]
    return f"it does not protect itself from {', '.join(names)}" if names else "it also shuts down for other reasons"


def _startup(seen: SeenRegister) -> str:
    words = ["its torque comes on with the power"] if seen.found & 1 else []
    return " and ".join([*words, *(["settings in RAM outlive the power"] if seen.found & RESTORES_RAM else [])]) or (
        "nothing outlives the power"
    )


def _si(seen: SeenRegister, register: str = "profile_velocity") -> str:
    item = seen.servo.model.register(register)
    return number(item.to_si(seen.found), item.unit)


#: register → what it does, in the order in which differences are told. All of them are read and recorded.
SETTINGS: Mapping[str, Setting] = {
    "operating_mode": Setting("it does not go to positions", lambda seen: True),
    "drive_mode": Setting(_drive, lambda seen: True),
    "homing_offset": Setting(lambda seen: f"its angles are shifted by {_si(seen, 'homing_offset')}", lambda seen: True),
    "min_position_limit": Setting(_limit, _narrow),
    "max_position_limit": Setting(_limit, _narrow),
    "profile_velocity": Setting(_velocity, _slow),
    "profile_acceleration": Setting(_acceleration, lambda seen: seen.found != 0 and _slow(seen)),
    "secondary_id": Setting(_second, _shadow),
    "pwm_limit": Setting(_push, _weak),
    "goal_pwm": Setting(_push),  # raised to its limit whenever torque comes on
    "position_p_gain": Setting(_stiffness, _soft),
    "position_i_gain": Setting("it pushes on while an error stands"),
    "position_d_gain": Setting("it damps its motion otherwise"),
    "feedforward_1st_gain": Setting("it pushes with the velocity of its profile"),
    "feedforward_2nd_gain": Setting("it pushes with the acceleration of its profile"),
    "velocity_limit": Setting("it bounds what profile_velocity may be"),
    "current_limit": Setting("without effect on position control"),
    "goal_current": Setting("without effect on position control"),
    "velocity_p_gain": Setting("without effect on position control"),
    "velocity_i_gain": Setting("without effect on position control"),
    "moving_threshold": Setting("it says `moving` at another speed"),
    "temperature_limit": Setting(lambda seen: f"it shuts down at {seen.found} °C"),
    "max_voltage_limit": Setting(lambda seen: f"it shuts down above {number(seen.found / 10, 'V', decimals=1)}"),
    "min_voltage_limit": Setting(lambda seen: f"it shuts down below {number(seen.found / 10, 'V', decimals=1)}"),
    "shutdown": Setting(_shutdown),
    "startup_configuration": Setting(_startup),
    "status_return_level": Setting("it leaves some instructions unanswered"),
    "protocol_type": Setting("it speaks another protocol"),
    # How fast a bus can be asked is measured, and every answer of the motion is the same.
    "return_delay_time": Setting("it answers later or sooner", factory=False),
}

RECORDED = ("firmware_version", *SETTINGS)


@dataclass(frozen=True)
class Expected:
    """A register's counts as they should be, and who says so (one of BY_…)."""

    counts: int
    by: str


@dataclass(frozen=True)
class Difference:
    """One register that is not as it should be.

    Attributes:
        does: what it does to a motion. stops: whether nothing may move before somebody has seen it.
        mended: how, in words.
    """

    joint: str
    id: int
    register: str
    found: int
    expected: int
    by: str
    does: str
    stops: bool
    mended: str

    @property
    def reads(self) -> str:
        """Without the joint."""
        return f"{self.register} is {self.found}, {self.by} {self.expected}: {self.does}"

    @property
    def what(self) -> str:
        return f"{self.joint} (id {self.id}): {self.reads}"

    def __str__(self) -> str:
        return f"{self.what} → {self.mended}"

    def as_fact(self) -> dict[str, Any]:
        """As a recording's facts keep it."""
        return {
            "joint": self.joint, "register": self.register, "is": self.found, "expected": self.expected, "by": self.by,
            "stops": self.stops,
        }  # fmt: skip


def in_words(found: Sequence[Difference], *, remedy: bool = True) -> list[str]:
    """What differs and what mends it, one line for all servos in which it differs alike."""
    told: dict[str, list[Difference]] = {}
    for one in found:
        told.setdefault(f"{one.reads} → {one.mended}" if remedy else one.reads, []).append(one)
    return [
        f"{f'{len(alike)} servos' if len(alike) > 1 else f'{alike[0].joint} (id {alike[0].id})'}: {words}"
        for words, alike in told.items()
    ]


def read_state(servos: Servos, registers: Iterable[str] = RECORDED) -> dict[str, dict[str, int]]:
    """joint → register → counts, of every servo that has the register.

    Raises:
        HardwareFault: one does not answer.
    """
    table: dict[str, dict[str, int]] = {joint: {} for joint in servos.joints}
    for register in registers:
        able = [servo.joint for servo in servos.servos if _has(servo, register)]
        if able:
            for joint, counts in servos.read_all(register, able).items():
                table[joint][register] = counts
    return table


def _has(servo: Servo, register: str) -> bool:
    item = servo.model.registers.get(register)
    return item is not None and item.min_firmware <= (99 if servo.firmware is None else servo.firmware)


def factory(model: ServoModel) -> dict[str, Expected]:
    """register → what a servo of this model has after a factory reset and a restart."""
    values = {
        name: Expected(item.default, BY_FACTORY)
        for name, setting in SETTINGS.items()
        if setting.factory and (item := model.registers.get(name)) is not None and item.default is not None
    }
    # Set by the servo itself from its limits, whatever they are.
    for goal in ("goal_pwm", "goal_current"):
        values.pop(goal, None)
    return values


def expected(
    model: ServoModel,
    *,
    ours: Mapping[str, int] = {},
    passport: Mapping[str, int] = {},
    robot_toml: Mapping[str, int] = {},
) -> dict[str, Expected]:
    """register → what it should be, and by whom.

    Args:
        ours: what we set for the motion at hand.
        passport: what stood when the robot was last found to be as it should be.
        robot_toml: what `robot.toml` names itself; it is the newer word on these where both speak.
    """
    wanted = factory(model)
    wanted |= {name: Expected(counts, BY_PASSPORT) for name, counts in passport.items() if name in SETTINGS}
    wanted |= {name: Expected(counts, BY_ROBOT_TOML) for name, counts in robot_toml.items()}
    wanted |= {name: Expected(counts, BY_US) for name, counts in ours.items() if name in SETTINGS}
    return wanted


def of_robot_toml(config: RobotConfig) -> dict[str, int]:
    """register → counts, of those that `robot.toml` itself names."""
    return {
        "pwm_limit": round(config.bus.pwm_limit * PWM_FULL),
        "return_delay_time": round(config.bus.return_delay_s / 2e-6),
    }


def differences(
    servos: Sequence[Servo],
    found: Mapping[str, Mapping[str, int]],
    wanted: Mapping[str, Mapping[str, Expected]],
    limits_rad: Mapping[str, tuple[float, float]] = {},
) -> list[Difference]:
    """Every register that is not as it should be, what makes a motion wrong first.

    Args:
        found: as `read_state` gives it. wanted: joint → register → as `expected` gives it.
        limits_rad: joint → limits of its commands.
    """
    ids, out = frozenset(servo.id for servo in servos), list[Difference]()
    for servo in servos:
        table = found.get(servo.joint, {})
        for register, setting in SETTINGS.items():
            goal = _goal(register, table, wanted.get(servo.joint, {}))
            if register not in table or goal is None or _alike(servo.model, register, table[register], goal):
                continue
            seen = SeenRegister(servo, table[register], table, limits_rad.get(servo.joint), ids)
            out.append(
                Difference(
                    servo.joint,
                    servo.id,
                    register,
                    seen.found,
                    goal.counts,
                    goal.by,
                    setting.words(seen),
                    setting.stops(seen),
                    _mended(servo, register, table),
                )
            )
    return sorted(out, key=lambda one: not one.stops)


def differences_of_robot(
    servos: Sequence[Servo],
    found: Mapping[str, Mapping[str, int]],
    config: RobotConfig,
    passport: Mapping[str, Mapping[str, int]],
) -> list[Difference]:
    """The same for servos at rest, of a robot that has a `robot.toml`; `passport` as `passport_registers` gives it."""
    named = of_robot_toml(config)
    wanted = {s.joint: expected(s.model, passport=passport.get(s.joint, {}), robot_toml=named) for s in servos}
    limits = {motor.joint: (motor.min_rad, motor.max_rad) for motor in config.motors.values()}
    return differences(servos, found, wanted, limits)


def _goal(register: str, table: Mapping[str, int], wanted: Mapping[str, Expected]) -> Expected | None:
    """What is expected; a goal's bound follows its limit, as it does when the servo starts."""
    limits = {"goal_pwm": "pwm_limit", "goal_current": "current_limit"}
    goal, limit = wanted.get(register), limits.get(register)
    if limit is None or (goal is not None and goal.by == BY_US) or limit not in table:
        return goal
    return Expected(table[limit], f"{BY_LIMIT} {limit} is")


def _alike(model: ServoModel, register: str, found: int, goal: Expected) -> bool:
    if found == goal.counts or (goal.by == BY_FACTORY and found in FACTORY_BEFORE.get((model.name, register), ())):
        return True
    # A goal's bound above its limit bounds nothing more.
    if goal.by.startswith(BY_LIMIT) and abs(found) >= goal.counts:
        return True
    # Extended position mode does all that position mode does, and a joint across the encoder's seam needs it.
    if register == "operating_mode":
        return {found, goal.counts} <= {POSITION, EXTENDED_POSITION}
    return register == "secondary_id" and min(found, goal.counts) >= 253  # all of them say: none


def _mended(servo: Servo, register: str, table: Mapping[str, int]) -> str:
    if servo.model.register(register).address < EEPROM_END:
        return f"{MENDED_BY} mends it"
    if table.get("startup_configuration", 0) & RESTORES_RAM:
        return f"{MENDED_BY} mends it; power off and on does not, since startup_configuration brings it back"
    return f"power off and on mends it, or {MENDED_BY}"


def stopping(found: Iterable[Difference]) -> list[Difference]:
    """Those that make a motion wrong or unsafe."""
    return [one for one in found if one.stops]


def refusal(found: Sequence[Difference]) -> tuple[str, str]:
    """What is wrong and what to do, of differences that stop a motion."""
    first, rest = found[0], len(found) - 1
    more = f", and {rest} more such register{'s' if rest > 1 else ''}" if rest else ""
    return (
        f"nothing moves while a register is other than expected: {first.what}{more}",
        f"{first.mended}; a recording command goes on with --anyway",
    )


def passport_registers(folder: RobotFolder | None, *, real: bool) -> dict[str, dict[str, int]]:
    """joint → register → counts as the robot's passport has them: as they stood after its last inventory.

    Args:
        real: whether it is the real robot, of which a virtual one's inventory says nothing.
    """
    inventory = None if folder is None else latest(folder, "inventory", real=real)
    kept = {} if inventory is None else inventory.data.get("registers", {})
    if not isinstance(kept, Mapping):
        return {}
    return {
        str(joint): {str(name): counts for name, counts in table.items() if isinstance(counts, int)}
        for joint, table in kept.items()
        if isinstance(table, Mapping)
    }
