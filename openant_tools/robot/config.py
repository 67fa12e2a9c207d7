"""`robot.toml`: what is known of one robot, as frozen dataclasses, and what may not stand in it.

The file belongs to its owner: comments, order and unknown keys stay as they are (`folder` writes it). Units are SI.
"""

from __future__ import annotations

import datetime
import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from openant_tools.errors import BadInput
from openant_tools.files import decoded, parse_toml
from openant_tools.numbers import literal
from openant_tools.robot.fields import ConfigProblem, choice, number, port, read, stranger, switch, text, vector, whole
from openant_tools.robot.joints import JOINT_NAMES, JOINTS, Kind
from openant_tools.robot.kit import KITS, PLATFORM_PWM_LIMIT
from openant_tools.robot.servo import BAUD_CODES, SERVO_MODELS, ServoModel

__all__ = [
    "ACTION_PRESETS",
    "CONFIG_NAME",
    "ActionRange",
    "Actions",
    "Arena",
    "BusSection",
    "CameraSection",
    "ConfigProblem",
    "EffectEntry",
    "ImuSection",
    "MotorSection",
    "Ports",
    "Provenance",
    "RobotConfig",
    "TimingSection",
    "covers",
    "editable_document",
    "parse_config",
    "parse_effects",
    "read_document",
]  # fmt: skip

CONFIG_NAME = "robot.toml"
#: bytes; a whole robot has some 12,000, and one that edits it waits a second for each 100,000
LARGEST_ROBOT = 512 * 1024
TURN = 2 * math.pi
#: Two turns: more than any mounting has, less than any angle in degrees.
MAX_OFFSET_RAD = 2 * TURN
MAX_ANGLE_RAD = math.pi
#: Signals that can have measured bounds, by the names of run tables, with their largest conceivable size.
OBSERVED: Mapping[str, tuple[str, float]] = {
    "pos": ("rad", MAX_ANGLE_RAD), "vel": ("rad/s", 100.0), "acc": ("m/s²", 320.0), "gyro": ("rad/s", 70.0),
}  # fmt: skip


@dataclass(frozen=True)
class Ports:
    """Where the robot is plugged in; "" while unknown.

    Attributes:
        bus: serial device of the servos' adapter; best a path below /dev/serial/by-id, which survives replugging.
        imu: serial device of the flight controller.
        camera: number or device of the overhead camera.
    """

    bus: str | int = port()
    imu: str | int = port()
    camera: str | int = port()


@dataclass(frozen=True)
class BusSection:
    """How the servos are spoken to.

    Attributes:
        baud: bits per second, of every servo.
        return_delay_s: what each servo waits before it answers (register 9).
        write_read_gap_s: from the last byte of a write to the next read; below 0.2 ms servos miss the read.
        pwm_limit: share of full duty that the servos may use (register 36).
        watchdog_s: servos stop by themselves after this long without an instruction (register 98); 0 is off,
            and then the robot may be watched, but not moved.
        chain: lists of joints, each in the order of its cable, from the adapter outwards.
    """

    baud: int = choice(tuple(BAUD_CODES.values()), "baud rate that servos have", 1_000_000)
    return_delay_s: float = number(0, 508e-6, "s", 0.0)
    write_read_gap_s: float = number(0, 0.1, "s", 0.0002)
    pwm_limit: float = number(0, 1, "", PLATFORM_PWM_LIMIT)
    watchdog_s: float = number(0.02, 2.54, "s", 0.2, or_zero=True)
    chain: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class MotorSection:
    """One joint's servo and how it is mounted: joint angle = direction · (servo angle − zero offset).

    Attributes:
        joint: which joint it drives.
        id: on the bus.
        model: the servo model's name.
        direction: 1, or −1 for a servo that is mounted the other way round.
        zero_offset_rad: the servo's angle where the joint is at zero.
        min_rad, max_rad: limits of commands, at the joint.
    """

    joint: str
    id: int = whole(0, 252)
    model: str = choice(tuple(SERVO_MODELS), "servo model")
    zero_offset_rad: float = number(-MAX_OFFSET_RAD, MAX_OFFSET_RAD, "rad")
    min_rad: float = number(-MAX_ANGLE_RAD, MAX_ANGLE_RAD, "rad")
    max_rad: float = number(-MAX_ANGLE_RAD, MAX_ANGLE_RAD, "rad")
    direction: int = choice((1, -1), "direction", 1)

    @property
    def servo(self) -> ServoModel:
        return SERVO_MODELS[self.model]

    @property
    def kind(self) -> Kind:
        return JOINTS[self.joint].kind


@dataclass(frozen=True)
class ImuSection:
    """The flight controller in the torso.

    Attributes:
        mounting_rad: rotation vector from the sensor's frame to the body's.
        gyro_bias_rad_s, acc_bias_m_s2: what it reads too much, in the body's frame.
        acc_counts_per_g: raw accelerometer counts for 1 g, which differs by firmware; 0 while unknown.
        gyro_counts_per_dps: raw gyro counts for 1 °/s: 16.384 where a step is 61.035 mdps, 14.286 where it is 70 mdps.
    """

    mounting_rad: tuple[float, ...] = vector(3, -TURN, TURN, "rad", (0.0, 0.0, 0.0))
    gyro_bias_rad_s: tuple[float, ...] = vector(3, -2, 2, "rad/s", (0.0, 0.0, 0.0))
    acc_bias_m_s2: tuple[float, ...] = vector(3, -5, 5, "m/s²", (0.0, 0.0, 0.0))
    acc_counts_per_g: float = number(0, 32768, "", 0.0)
    gyro_counts_per_dps: float = number(1, 1000, "", 16.384)


@dataclass(frozen=True)
class CameraSection:
    """The overhead camera and the tags that it looks for.

    Attributes:
        fov_diagonal_rad: angle from corner to corner of the picture; used while the lens has not been calibrated.
        tag_family: which family both tags are of.
        origin_tag_id, body_tag_id: the tag on the floor, and the one on the torso; −1 while unknown.
        origin_tag_size_m, body_tag_size_m: length of a tag's edge. A wrong one scales every distance.
        body_tag_position_m: centre of the body tag in the torso's frame.
        body_tag_yaw_rad: the tag's up-direction against the torso's x axis.
        latency_s: from exposure to arrival, as measured.
        exposure, focus: in the driver's unit; automatic where absent.
        size_px: width and height of the pictures with which the lens was calibrated.
        focal_px, centre_px: fx and fy, cx and cy.
        distortion: k1, k2, p1, p2, k3 (OpenCV's order).
    """

    fov_diagonal_rad: float = number(0.1, 3.0, "rad", math.radians(60))
    origin_tag_id: int = whole(-1, 100_000, 0)
    body_tag_id: int = whole(-1, 100_000, -1)
    origin_tag_size_m: float = number(0.005, 2, "m", 0.10)
    body_tag_size_m: float = number(0.005, 2, "m", 0.045)
    tag_family: str = text("tagCircle21h7")
    body_tag_position_m: tuple[float, ...] = vector(3, -1, 1, "m", (0.0, 0.0, 0.085))
    body_tag_yaw_rad: float = number(-TURN, TURN, "rad", 0.0)
    latency_s: float | None = number(0, 2, "s", None)
    exposure: float | None = number(0, 1e6, "", None)
    focus: float | None = number(0, 1e6, "", None)
    size_px: tuple[float, ...] | None = vector(2, 16, 20_000, "px", None)
    focal_px: tuple[float, ...] | None = vector(2, 1, 1e6, "px", None)
    centre_px: tuple[float, ...] | None = vector(2, 0, 20_000, "px", None)
    distortion: tuple[float, ...] = vector(5, -1000, 1000, "", (0.0, 0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Arena:
    """The circle on the floor in which the robot learns, in the frame of the origin's tag.

    Attributes:
        centre_m: x and y of its centre; absent while it has not been measured.
        radius_m: of the circle; the paper's where nobody says otherwise.
    """

    centre_m: tuple[float, ...] | None = vector(2, -100, 100, "m", None)
    radius_m: float = number(0.05, 50, "m", 0.3)


@dataclass(frozen=True)
class TimingSection:
    """The control loop.

    Attributes:
        dt_s: from one action to the next.
    """

    dt_s: float = number(0.002, 2, "s", 0.12)


@dataclass(frozen=True)
class ActionRange:
    """What actions of −1…1 mean: joint target = centre + action · half range, in rad, by kind of joint."""

    hip_centre_rad: float
    hip_half_range_rad: float
    knee_centre_rad: float
    knee_half_range_rad: float

    def centre(self, kind: Kind) -> float:
        return self.hip_centre_rad if kind == "hip" else self.knee_centre_rad

    def half_range(self, kind: Kind) -> float:
        return self.hip_half_range_rad if kind == "hip" else self.knee_half_range_rad


def _range(hip_half: float, knee: float, knee_half: float) -> ActionRange:
    return ActionRange(0.0, math.radians(hip_half), math.radians(knee), math.radians(knee_half))


#: The platform's ranges: its default (and the paper's), what its SAC scripts set, what its SARSA scripts set.
ACTION_PRESETS: Mapping[str, ActionRange] = {
    "platform": _range(45, -50, 20),
    "sac": _range(30, -50, 20),
    "sarsa": _range(30, -60, 45),
}


@dataclass(frozen=True)
class Actions:
    """The range of actions: a preset, and what this robot has different from it."""

    preset: str = choice(tuple(ACTION_PRESETS), "preset", "platform")
    hip_centre_rad: float | None = number(-MAX_ANGLE_RAD, MAX_ANGLE_RAD, "rad", None)
    hip_half_range_rad: float | None = number(0, MAX_ANGLE_RAD, "rad", None)
    knee_centre_rad: float | None = number(-MAX_ANGLE_RAD, MAX_ANGLE_RAD, "rad", None)
    knee_half_range_rad: float | None = number(0, MAX_ANGLE_RAD, "rad", None)

    @property
    def range(self) -> ActionRange:
        base = ACTION_PRESETS[self.preset]

        def own(mine: float | None, preset: float) -> float:
            return preset if mine is None else mine

        return ActionRange(
            own(self.hip_centre_rad, base.hip_centre_rad),
            own(self.hip_half_range_rad, base.hip_half_range_rad),
            own(self.knee_centre_rad, base.knee_centre_rad),
            own(self.knee_half_range_rad, base.knee_half_range_rad),
        )


@dataclass(frozen=True)
class EffectEntry:
    """One `[[effect]]` that acts in simulation (formats, section 4).

    Attributes:
        effect: its name in the effect catalogue.
        joints: the joints it belongs to, or "all" or "body".
        parameters: by the catalogue's names, SI; a parameter may also be a list (a direction, a position).
        enabled: whether it acts.
        pair: the mark of the model that it was fitted with (`robot.pair`); None goes with any.
    """

    effect: str = text()
    joints: str | tuple[str, ...] = "all"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    enabled: bool = switch(True)
    pair: str | None = text(None)


@dataclass(frozen=True)
class Provenance:
    """Where a value came from.

    Attributes:
        how: one word or two: "nominal", "imported", "by hand", "measured", "fitted".
        command: the command that wrote it.
        recording: the recording it was measured in, relative to the robot's folder.
        date: when.
        low, high: how certain: the 95 % interval, in the value's unit.
    """

    how: str = text()
    command: str | None = text(None)
    recording: str | None = text(None)
    date: datetime.datetime | None = None
    low: float | None = number(-math.inf, math.inf, "", None)
    high: float | None = number(-math.inf, math.inf, "", None)

    @classmethod
    def measured(
        cls, command: str, recording: str | None = None, low: float | None = None, high: float | None = None
    ) -> Provenance:
        """Of what a command has measured just now."""
        return cls(
            "measured", command, recording, datetime.datetime.now(datetime.UTC).replace(microsecond=0), low, high
        )


@dataclass(frozen=True)
class RobotConfig:
    """Everything that `robot.toml` says and this software knows.

    Attributes:
        name: what its owner calls it.
        kit: "standard" or "lite".
        model: the MJCF that simulates it, relative to the folder.
        motors: joint → motor, complete, in the order of the joints.
        observation: name of a run table's column, such as `pos.hip_rr` or `gyro.x` → measured (low, high) of it.
        effects: what acts in simulation beside the MJCF.
        provenance: dotted path, or the front of one → where what stands there came from; * is any one key, as in
            `motors.*.zero_offset_rad`.
        unknown: top-level tables that this software does not know.
    """

    name: str = text()
    kit: str = choice(tuple(KITS), "kit")
    model: str = text()
    ports: Ports = Ports()
    bus: BusSection = BusSection()
    motors: Mapping[str, MotorSection] = field(default_factory=dict)
    imu: ImuSection = ImuSection()
    camera: CameraSection = CameraSection()
    arena: Arena = Arena()
    timing: TimingSection = TimingSection()
    actions: Actions = Actions()
    observation: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    effects: tuple[EffectEntry, ...] = ()
    provenance: Mapping[str, Provenance] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()

    @property
    def ids(self) -> tuple[int, ...]:
        """The servos' ids in the order of the joints."""
        return tuple(motor.id for motor in self.motors.values())

    def motor_with_id(self, id: int) -> MotorSection | None:
        return next((motor for motor in self.motors.values() if motor.id == id), None)

    def provenance_of(self, path: str) -> Provenance | None:
        """Where the value at a dotted path came from: the longest entry that covers it, the one without * first."""
        entries = [entry for entry in self.provenance if covers(entry, path)]
        return (
            self.provenance[max(entries, key=lambda entry: (entry.count("."), -entry.count("*")))] if entries else None
        )


def covers(entry: str, path: str) -> bool:
    """Whether a provenance entry is about a dotted path: the same, or a front of it, with * for any one key."""
    entry_keys, keys = entry.split("."), path.split(".")
    return len(entry_keys) <= len(keys) and all(own in ("*", key) for own, key in zip(entry_keys, keys, strict=False))


_SECTIONS: Mapping[str, type[Any]] = {
    "ports": Ports, "bus": BusSection, "imu": ImuSection, "camera": CameraSection, "arena": Arena, "timing": TimingSection,
    "actions": Actions,
}  # fmt: skip
#: settings of files of before that are read no more → why
RETIRED: Mapping[str, str] = {"bus.latency_timer_ms": "the adapter itself is asked, and set to 1 ms"}
_KNOWN = {
    "schema",
    "name",
    "kit",
    "model",
    *_SECTIONS,
    "motors",
    "observation",
    "effect",
    "provenance",
    "platform",
    "identified",
    "bench",
}


def _suggest(name: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]!r}?" if close else f"the joints are {', '.join(names)}"


def _motors(table: Any, problems: list[ConfigProblem]) -> dict[str, MotorSection]:
    motors: dict[str, MotorSection] = {}
    if not isinstance(table, Mapping):
        problems.append(
            ConfigProblem(
                "motors",
                "is missing" if table is None else "is no table",
                "each joint needs a table [motors.JOINT]; a file cut short has lost them",
            )
        )
        return motors
    for joint in table:
        if joint not in JOINTS:
            problems.append(ConfigProblem(f"motors.{joint}", "there is no such joint", _suggest(joint, JOINT_NAMES)))
    for joint in JOINT_NAMES:
        if joint not in table:
            problems.append(ConfigProblem(f"motors.{joint}", "is missing", f"add a table [motors.{joint}]"))
            continue
        motor = read(MotorSection, table[joint], f"motors.{joint}", problems, joint=joint)
        if motor is not None:
            motors[joint] = motor
    for motor in motors.values():
        if motor.min_rad >= motor.max_rad:
            problems.append(
                ConfigProblem(
                    f"motors.{motor.joint}.min_rad",
                    f"{literal(motor.min_rad)} is not below max_rad, {literal(motor.max_rad)}",
                    "swap them",
                )
            )
    owners: dict[int, str] = {}
    for motor in motors.values():
        first = owners.setdefault(motor.id, motor.joint)
        if first != motor.joint:
            problems.append(
                ConfigProblem(
                    f"motors.{motor.joint}.id",
                    f"{motor.id} is also the id of {first}",
                    "two servos cannot share an id on one bus",
                )
            )
    return motors


def _joint_names(
    value: list[Any], path: str, problems: list[ConfigProblem], known: Sequence[str] = JOINT_NAMES
) -> tuple[str, ...]:
    """The joints in a list; what is none, or stands in it twice, is a problem."""
    joints: list[str] = []
    for joint in value:
        if not isinstance(joint, str) or joint not in known:
            problems.append(ConfigProblem(path, f"there is no joint {joint!r}", _suggest(str(joint), known)))
        elif joint in joints:
            problems.append(ConfigProblem(path, f"{joint} stands in it twice"))
        else:
            joints.append(joint)
    return tuple(joints)


def _chain(value: Any, problems: list[ConfigProblem]) -> tuple[tuple[str, ...], ...]:
    if not (isinstance(value, list) and all(isinstance(cable, list) for cable in value)):
        problems.append(ConfigProblem("bus.chain", "is no list of lists of joints"))
        return ()
    _joint_names([joint for cable in value for joint in cable], "bus.chain", problems)
    return tuple(tuple(str(joint) for joint in cable) for cable in value)


def _leaves(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        full = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            yield from _leaves(value, full)
        else:
            yield full, value


def _observation(table: Any, problems: list[ConfigProblem]) -> dict[str, tuple[float, float]]:
    bounds: dict[str, tuple[float, float]] = {}
    if not isinstance(table, Mapping):
        problems.append(ConfigProblem("observation", "is no table"))
        return bounds
    for column, value in _leaves(table):
        signal, _, part = column.partition(".")
        unit, largest = OBSERVED.get(signal, ("", math.inf))
        known = part in JOINTS if signal in ("pos", "vel") else part in "xyz" and len(part) == 1
        if signal not in OBSERVED or not known:
            problems.append(
                ConfigProblem(
                    f"observation.{column}",
                    "is no signal that is observed",
                    "known are pos.JOINT, vel.JOINT, acc.x|y|z and gyro.x|y|z",
                    "note",
                )
            )
        elif not (
            isinstance(value, list)
            and len(value) == 2
            and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        ):
            problems.append(ConfigProblem(f"observation.{column}", "needs two numbers, [low, high]"))
        elif not -largest <= value[0] < value[1] <= largest:
            problems.append(
                ConfigProblem(
                    f"observation.{column}",
                    f"{literal(value[0])} to {literal(value[1])} {unit} cannot be",
                    f"low must be below high, both within ±{literal(largest, 4)} {unit}",
                )
            )
        else:
            bounds[column] = (float(value[0]), float(value[1]))
    return bounds


def parse_effects(
    entries: Any, problems: list[ConfigProblem], known: Sequence[str] = JOINT_NAMES
) -> tuple[EffectEntry, ...]:
    """What the `[[effect]]` tables of a document say; what cannot be goes to `problems`.

    Args:
        known: the robot's joints.
    """
    if not isinstance(entries, list):
        problems.append(ConfigProblem("effect", "is no list of tables", "write each effect as a table [[effect]]"))
        return ()
    effects: list[EffectEntry] = []
    for n, entry in enumerate(entries):
        path = f"effect[{n + 1}]"
        table = entry if isinstance(entry, Mapping) else {}
        joints = table.get("joints", "all")
        if isinstance(joints, list):
            joints = _joint_names(joints, f"{path}.joints", problems, known)
        elif joints not in ("all", "body"):
            remedy = f'write ["{joints}"]' if isinstance(joints, str) and joints in known else None
            problems.append(
                ConfigProblem(f"{path}.joints", f'{joints!r} is neither "all" nor "body" nor a list of joints', remedy)
            )
        parameters = table.get("parameters", {})
        if not isinstance(parameters, Mapping):
            problems.append(ConfigProblem(f"{path}.parameters", "is no table", "write { delay_s = 0.02 }"))
            parameters = {}
        effect = read(EffectEntry, entry, path, problems, joints=joints, parameters=dict(parameters))
        if effect is not None:
            effects.append(effect)
    return tuple(effects)


def _provenance(table: Any, problems: list[ConfigProblem]) -> dict[str, Provenance]:
    entries: dict[str, Provenance] = {}
    if not isinstance(table, Mapping):
        problems.append(ConfigProblem("provenance", "is no table"))
        return entries
    for path, value in table.items():
        key = f'provenance."{path}"'
        date = value.get("date") if isinstance(value, Mapping) else None
        if isinstance(date, datetime.date) and not isinstance(date, datetime.datetime):
            date = datetime.datetime(date.year, date.month, date.day)
        elif date is not None and not isinstance(date, datetime.datetime):
            problems.append(
                ConfigProblem(f"{key}.date", "is no date", "write it as 2026-01-31T12:00:00Z, without quotes")
            )
            date = None
        entry = read(Provenance, value, key, problems, date=date)
        if entry is not None:
            entries[path] = entry
    return entries


def read_document(data: bytes, where: str | Path) -> dict[str, Any]:
    """What a robot's file, given by its bytes, says; raises BadInput with line and column where it is no TOML."""
    if len(data) > LARGEST_ROBOT:
        raise BadInput(f"is larger than {LARGEST_ROBOT // 1024} KiB", where=where, remedy="is it a robot's?")
    remedy, text = "mend it by hand", decoded(data, where)
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise BadInput("holds zero bytes, as a power cut leaves them", where=f"{where}, line {line}", remedy=remedy)
    return parse_toml(text, where, remedy)


def editable_document(data: bytes, where: str | Path) -> tomlkit.TOMLDocument:
    """The same with comments, order and all else that its owner wrote, to be changed and written."""
    read_document(data, where)  # first: it takes a tenth of the time, and is strict
    try:
        return tomlkit.parse(decoded(data, where))
    except (TOMLKitError, RecursionError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise BadInput(f"cannot be edited: {error}", where=where, remedy="mend it by hand") from None


def retired(problem: ConfigProblem) -> ConfigProblem:
    """A key that nobody reads any more says so, instead of that nobody knows it."""
    why = RETIRED.get(problem.key)
    return problem if why is None else ConfigProblem(problem.key, f"is read no more: {why}", "the line can go", "note")


def parse_config(document: Mapping[str, Any]) -> tuple[RobotConfig | None, list[ConfigProblem]]:
    """What a document says, and everything in it that cannot be or is probably not meant.

    Args:
        document: plain values, as `read_document` gives them.

    Returns:
        The configuration, None where an error stands among the problems; and the problems in the file's order of
        sections.
    """
    problems: list[ConfigProblem] = []
    schema = document.get("schema", "openant.robot/1")
    if schema != "openant.robot/1":
        problems.append(
            ConfigProblem(
                "schema", f"{schema!r} is not known", "this software reads openant.robot/1; update it, or mend the line"
            )
        )
    parts: dict[str, Any] = {}
    for name, kind in _SECTIONS.items():
        given = {}
        if name == "bus" and isinstance(document.get("bus"), Mapping) and "chain" in document["bus"]:
            given["chain"] = _chain(document["bus"]["chain"], problems)
        parts[name] = read(kind, document.get(name, {}), name, problems, **given)
    unknown = tuple(key for key in document if key not in _KNOWN)
    problems += [stranger(key, key, sorted(_KNOWN)) for key in unknown]
    config = read(
        RobotConfig,
        document,
        "",
        problems,
        **parts,
        motors=_motors(document.get("motors"), problems),
        observation=_observation(document.get("observation", {}), problems),
        effects=parse_effects(document.get("effect", []), problems),
        provenance=_provenance(document.get("provenance", {}), problems),
        unknown=unknown,
    )
    problems = [retired(problem) for problem in problems]
    errors = any(problem.severity == "error" for problem in problems)
    return (None if errors else config), problems
