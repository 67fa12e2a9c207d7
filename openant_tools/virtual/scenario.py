"""A scenario: one TOML file that says what a virtual robot is and what is wrong with it (formats, section 7)."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.files import LARGEST_TOML, parse_toml, read_text, reading
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import KITS, home_angles
from openant_tools.robot.servo import baud_code, servo_model
from openant_tools.virtual.camera_scene import OverheadCameraSettings, TagOnFloor, TagOnRobot
from openant_tools.virtual.faults import Fault
from openant_tools.virtual.flight_controller import FlightControllerSettings
from openant_tools.virtual.imperfections import ScenarioEffect, apply_entry, nearest
from openant_tools.virtual.motor import MotorSettings
from openant_tools.virtual.seal import KEY_VARIABLE, is_sealed, open_sealed, read_key, seal
from openant_tools.virtual.world import ServoSetup, WorldSettings, standard_servos

__all__ = ["Scenario", "check_sealable", "load_scenario", "parse_scenario", "read_scenario_file", "seal_scenario"]

#: s; with play or spring in a gear the teeth want the finer step.
STEP_S, FINE_STEP_S = 1e-3, 5e-4

_NUMBER = "a number"
#: what no check below foresaw, and what to do
NO_SCENARIO = ("something in it is of another kind than it should be", "docs/virtual-robot.md says what stands where")
#: section → key → what it takes
_SECTIONS: Mapping[str, Mapping[str, str]] = {
    "robot": {
        "kit": "standard or lite", "setup": "stand, floor or loose", "pose": 'angles by joint, "straight" or "home"',
        "heading_rad": _NUMBER, "position_m": "two numbers", "step_s": _NUMBER, "eeprom": "a file",
        "plugged": "a list of joints", "factory": "true or false",
    },
    "bus": {
        "baud": _NUMBER, "return_delay_s": _NUMBER, "latency_timer_ms": _NUMBER, "write_read_gap_s": _NUMBER,
        "byte_error": _NUMBER, "response_s": _NUMBER, "waits_for_silent": "true or false", "silent_pause_s": _NUMBER,
        "chain": "lists of joints",
    },
    "supply": {"volts": _NUMBER, "resistance_ohm": _NUMBER},
    "room": {"ambient_c": _NUMBER, "swing_k": _NUMBER, "period_s": _NUMBER},
    "clock": {"mode": "real or stepped", "doze": "true or false"},
}  # fmt: skip
_FREE_SECTIONS = ("imu", "camera", "motor")
_SERVO_KEYS = (
    "joint",
    "model",
    "id",
    "baud",
    "firmware",
    "reversed",
    "spline_offset",
    "mount_rad",
    "clock_ppm",
    "motor",
)


@dataclass
class Scenario:
    """A scenario read and checked.

    Attributes:
        name: for messages. world: what the robot is made of. faults: what happens over time.
        stepped: whether time is stepped. camera: whether there is one.
        eeprom: file that keeps the servos' EEPROM from one start to the next.
        plugged: joints on the cable at the start; None for all.
        sealed: it came out of a seal, so that the robot keeps its truth to itself.
    """

    name: str = "healthy standard Ant"
    world: WorldSettings = field(default_factory=lambda: WorldSettings(standard_servos()))
    faults: list[Fault] = field(default_factory=list)
    stepped: bool = False
    camera: bool = True
    eeprom: Path | None = None
    plugged: tuple[str, ...] | None = None
    sealed: bool = False


def load_scenario(path: Path, key_file: Path | None = None) -> Scenario:
    """Read a scenario file; BadInput names file, place and remedy.

    Args:
        key_file: opens a sealed one; None for what the environment names.
    """
    _, table = read_scenario_file(path)
    if sealed := is_sealed(table):
        key_file = key_file or (Path(os.environ[KEY_VARIABLE]) if os.environ.get(KEY_VARIABLE) else None)
        if key_file is None:
            raise BadInput("is sealed", where=path, remedy=f"name its key by --key-file or {KEY_VARIABLE}")
        table = parse_toml(open_sealed(table, read_key(key_file), path), path)
    with reading(path, *NO_SCENARIO):
        scenario = parse_scenario(table, str(path))
    scenario.sealed = sealed
    if scenario.eeprom is not None and not scenario.eeprom.is_absolute():
        scenario.eeprom = path.parent / scenario.eeprom
    return scenario


def read_scenario_file(path: Path) -> tuple[str, dict[str, Any]]:
    """The text of a scenario and the table in it as they stand, sealed or not; raises BadInput."""
    try:
        text = read_text(path, LARGEST_TOML)
    except OSError as error:
        raise BadInput(error.strerror or str(error), where=path, remedy="name a scenario file") from None
    return text, parse_toml(text, path, "mend it there; a scenario is TOML")


def seal_scenario(path: Path, key: bytes, out: Path) -> str:
    """Seal a scenario file that is good; its commitment. Raises BadInput."""
    return seal(check_sealable(path), key, out)


def check_sealable(path: Path) -> str:
    """The text of a scenario that is plain and good; raises BadInput."""
    text, table = read_scenario_file(path)
    if is_sealed(table):
        raise BadInput("is sealed already", where=path, remedy="seal the plain file")
    with reading(path, *NO_SCENARIO):
        parse_scenario(table, str(path))
    return text


def parse_scenario(table: Mapping[str, Any], name: str = "scenario") -> Scenario:
    """A scenario from a parsed TOML document; raises BadInput."""
    known = (*_SECTIONS, *_FREE_SECTIONS, "seed", "servo", "effect", "fault")
    for key in table:
        if key not in known:
            raise BadInput(f"unknown key {key!r}", where=name, remedy=nearest(key, known))
    sections = {section: _section(table, section, name) for section in _SECTIONS}
    robot, bus = sections["robot"], sections["bus"]
    seed = table.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise BadInput(f"seed = {seed!r}", where=name, remedy="a whole number, not below zero")
    kit = _choice(robot, "kit", tuple(KITS), "standard", f"{name}, [robot]")
    setup = _choice(robot, "setup", ("stand", "floor", "loose"), "stand", f"{name}, [robot]")
    factory = bool(robot.get("factory", setup == "loose"))
    servos = standard_servos(kit, factory=factory)
    for servo in servos:
        if "baud" in bus:
            servo.registers["baud_rate"] = _at(f"{name}, [bus]", baud_code, int(bus["baud"]))
        if "return_delay_s" in bus:
            servo.registers["return_delay_time"] = round(float(bus["return_delay_s"]) / 2e-6)
    world = WorldSettings(servos, seed=seed)
    _read_servos(table, world, name)
    world.body.kit, world.body.setup = kit, setup
    _read_robot(robot, world, f"{name}, [robot]")
    _read_bus(bus, world, f"{name}, [bus]")
    supply = sections["supply"]
    world.supply.volts = float(supply.get("volts", KITS[kit].supply_v))
    world.supply.resistance_ohm = float(supply.get("resistance_ohm", 0.0))
    room = sections["room"]
    world.ambient_c = float(room.get("ambient_c", 25.0))
    world.ambient_swing_k, world.ambient_period_s = float(room.get("swing_k", 0.0)), float(room.get("period_s", 3600.0))
    if not world.ambient_period_s > 0:
        raise BadInput("period_s = 0", where=f"{name}, [room]", remedy="the time of one swing, in s")
    world.doze = bool(sections["clock"].get("doze", False))
    world.imu = _fields(table.get("imu", {}), FlightControllerSettings, f"{name}, [imu]")
    camera = _read_camera(table.get("camera", {}), world, f"{name}, [camera]")
    joints = [servo.joint for servo in servos]
    for n, entry in enumerate(_tables(table, "effect", name)):
        _read_effect(entry, world, f"{name}, [[effect]] {n + 1}")
    faults = [
        Fault.of(entry, joints, f"{name}, [[fault]] {n + 1}") for n, entry in enumerate(_tables(table, "fault", name))
    ]
    elastic = any(servo.motor is not None and servo.motor.elastic for servo in servos)
    world.body.timestep_s = float(robot.get("step_s", FINE_STEP_S if elastic else STEP_S))
    if not 1e-5 <= world.body.timestep_s <= 2e-3:
        raise BadInput("step_s is out of reach", where=f"{name}, [robot]", remedy="0.00001 … 0.002")
    plugged = robot.get("plugged", [] if setup == "loose" else None)
    return Scenario(
        name=name,
        world=world,
        faults=faults,
        stepped=_choice(sections["clock"], "mode", ("real", "stepped"), "real", f"{name}, [clock]") == "stepped",
        camera=camera,
        eeprom=Path(robot["eeprom"]) if "eeprom" in robot else None,
        plugged=None if plugged is None else _joints(plugged, joints, f"{name}, [robot] plugged"),
    )


# ---- the parts ----


def _section(table: Mapping[str, Any], section: str, name: str) -> dict[str, Any]:
    where, known = f"{name}, [{section}]", _SECTIONS[section]
    values = table.get(section, {})
    if not isinstance(values, dict):
        raise BadInput("is not a section", where=where, remedy=f"write [{section}] and its keys below")
    for key, value in values.items():
        if key not in known:
            raise BadInput(f"unknown key {key!r}", where=where, remedy=nearest(key, known))
        if known[key] == _NUMBER:
            _checked_number(key, value, where, signed=key in ("heading_rad", "ambient_c"))
    return values


def _checked_number(key: str, value: Any, where: str, *, signed: bool = False) -> None:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not good or (value < 0 and not signed):
        raise BadInput(f"{key} = {value!r}", where=where, remedy="a number" if signed else "a number, not below zero")


def _choice(values: Mapping[str, Any], key: str, choices: Sequence[str], default: str, where: str) -> str:
    value = values.get(key, default)
    if value not in choices:
        raise BadInput(f"{key} = {value!r}", where=where, remedy=f"one of {', '.join(choices)}")
    return str(value)


def _tables(table: Mapping[str, Any], key: str, name: str) -> list[dict[str, Any]]:
    entries = table.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise BadInput(f"{key} is not a list of tables", where=name, remedy=f"write [[{key}]] with two brackets")
    return entries


def _joints(names: Any, known: Sequence[str], where: str) -> tuple[str, ...]:
    if not isinstance(names, list):
        raise BadInput(f"{names!r}", where=where, remedy="a list of joints")
    for name in names:
        if name not in known:
            raise BadInput(f"no joint {name!r}", where=where, remedy=nearest(str(name), known))
    return tuple(names)


def _fields(values: Any, kind: type, where: str) -> dict[str, Any]:
    """A section that fills a dataclass: keys and kinds of value checked against its fields."""
    if not isinstance(values, dict):
        raise BadInput("is not a section", where=where)
    defaults = {f.name: f for f in dataclasses.fields(kind)}
    out: dict[str, Any] = {}
    for key, value in values.items():
        if key not in defaults:
            raise BadInput(f"unknown key {key!r}", where=where, remedy=nearest(key, defaults))
        default = defaults[key].default
        if isinstance(default, tuple):
            if not isinstance(value, list) or len(value) != len(default):
                raise BadInput(f"{key} = {value!r}", where=where, remedy=f"a list of {len(default)} numbers")
            value = tuple(value)
        elif isinstance(default, bool) or isinstance(value, bool):
            if type(default) is not type(value):
                raise BadInput(f"{key} = {value!r}", where=where)
        elif isinstance(default, float) or default is dataclasses.MISSING:
            _checked_number(key, value, where, signed=True)
            value = float(value)
        elif not isinstance(value, type(default)):
            raise BadInput(f"{key} = {value!r}", where=where, remedy=f"like {default!r}")
        out[key] = value
    return out


def _read_servos(table: Mapping[str, Any], world: WorldSettings, name: str) -> None:
    by_joint = {servo.joint: servo for servo in world.servos}
    shared = _fields(table.get("motor", {}), MotorSettings, f"{name}, [motor]")
    named: set[str] = set()
    entries = _tables(table, "servo", name)
    for n, entry in enumerate(entries):
        where = f"{name}, [[servo]] {n + 1}"
        joint = entry.get("joint")
        if not isinstance(joint, str) or joint not in by_joint:
            raise BadInput(f"joint = {joint!r}", where=where, remedy=nearest(str(joint), by_joint))
        if joint in named:
            raise BadInput(f"{joint} stands here twice", where=where)
        named.add(joint)
        _read_servo(entry, by_joint[joint], f"{name}, [[servo]] {joint}")
    for servo in world.servos:
        own = {}
        for entry in entries:
            if entry["joint"] == servo.joint:
                own = _fields(entry.get("motor", {}), MotorSettings, f"{name}, [[servo]] {servo.joint}, motor")
        servo.motor = dataclasses.replace(MotorSettings.of(servo.model), **{**shared, **own})


def _read_servo(entry: Mapping[str, Any], servo: ServoSetup, where: str) -> None:
    if "model" in entry:
        try:
            servo.model = servo_model(entry["model"])
        except BadInput as error:
            raise BadInput(error.what, where=where, remedy=error.remedy) from None
    for key, value in entry.items():
        if key in ("joint", "model", "motor"):
            continue
        if key in ("reversed",):
            if not isinstance(value, bool):
                raise BadInput(f"{key} = {value!r}", where=where, remedy="true or false")
            servo.reversed = value
        elif key in ("mount_rad", "clock_ppm"):
            _checked_number(key, value, where, signed=True)
            setattr(servo, key, float(value))
        elif not isinstance(value, int) or isinstance(value, bool):
            raise BadInput(f"{key} = {value!r}", where=where, remedy="a whole number, as the register counts")
        elif key == "firmware":
            servo.firmware = value
        elif key == "spline_offset":
            servo.spline_offset = value
        elif key == "baud":
            servo.registers["baud_rate"] = _at(where, baud_code, value)
        else:
            if key not in servo.model.registers:
                known = [*_SERVO_KEYS, *servo.model.registers]
                raise BadInput(f"no register {key!r}", where=where, remedy=nearest(key, known))
            _at(where, servo.model.registers[key].check, value)
            servo.registers[key] = value


def _at(where: str, function: Any, value: Any) -> Any:
    """Call, and let what is refused name its place."""
    try:
        return function(value)
    except BadInput as error:
        raise BadInput(error.what, where=where, remedy=error.remedy) from None


def _read_robot(robot: Mapping[str, Any], world: WorldSettings, where: str) -> None:
    joints = [servo.joint for servo in world.servos]
    pose = robot.get("pose", "straight")
    if pose == "home":
        world.body.pose_rad = dict(zip(JOINT_NAMES, home_angles(), strict=True))
    elif isinstance(pose, dict):
        for joint, angle in pose.items():
            if joint not in joints:
                raise BadInput(f"pose: no joint {joint!r}", where=where, remedy=nearest(joint, joints))
            _checked_number(joint, angle, f"{where} pose", signed=True)
        world.body.pose_rad = {joint: float(angle) for joint, angle in pose.items()}
    elif pose != "straight":
        raise BadInput(f"pose = {pose!r}", where=where, remedy=_SECTIONS["robot"]["pose"])
    world.body.heading_rad = float(robot.get("heading_rad", 0.0))
    position = robot.get("position_m", [0.0, 0.0])
    if not isinstance(position, list) or len(position) != 2:
        raise BadInput(f"position_m = {position!r}", where=where, remedy="two numbers: [x, y]")
    world.body.position_m = (float(position[0]), float(position[1]))


def _read_bus(bus: Mapping[str, Any], world: WorldSettings, where: str) -> None:
    settings = world.bus
    settings.latency_timer_s = float(bus.get("latency_timer_ms", 1.0)) * 1e-3
    for key in ("write_read_gap_s", "byte_error", "response_s", "silent_pause_s"):
        if key in bus:
            setattr(settings, key, float(bus[key]))
    settings.waits_for_silent = bool(bus.get("waits_for_silent", True))
    if "chain" in bus:
        joints = [servo.joint for servo in world.servos]
        chains = bus["chain"]
        if not isinstance(chains, list) or not all(isinstance(chain, list) for chain in chains):
            raise BadInput("chain is not a list of lists", where=where, remedy='chain = [["hip_rr", "knee_rr"], …]')
        settings.chains = [[joints.index(name) for name in _joints(chain, joints, where)] for chain in chains]


def _read_camera(values: Any, world: WorldSettings, where: str) -> bool:
    """Whether there is a camera; its settings go into the world's."""
    if not isinstance(values, dict):
        raise BadInput("is not a section", where=where)
    rest = dict(values)
    present = rest.pop("present", True)
    tags: dict[str, Any] = {}
    for key, kind in (("origin", TagOnFloor), ("body", TagOnRobot)):
        tag = rest.pop(key, {})
        # origin = false: there is no such tag.
        tags[key] = None if tag is False else kind(**_fields(tag, kind, f"{where}, {key}"))
    world.camera = {**_fields(rest, OverheadCameraSettings, where), **tags}
    return bool(present)


def _read_effect(entry: Mapping[str, Any], world: WorldSettings, where: str) -> None:
    known = ("effect", "joints", "parameters", "enabled", "pair")  # the last is a model's; this robot has none
    for key in entry:
        if key not in known:
            raise BadInput(f"unknown key {key!r}", where=where, remedy=nearest(key, known))
    if not entry.get("enabled", True):
        return
    joints = entry.get("joints", "all")
    parameters = entry.get("parameters", {})
    if not isinstance(parameters, dict):
        raise BadInput("parameters is not a table", where=where, remedy="parameters = { delay_s = 0.02 }")
    scope = joints if isinstance(joints, str) else _joints(joints, [servo.joint for servo in world.servos], where)
    apply_entry(world, ScenarioEffect(str(entry.get("effect")), scope, parameters), where)
