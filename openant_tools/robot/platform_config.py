"""The platform's own robot configuration, `antNN.json`: read into `robot.toml`, and written for its software.

It is one flat object without schema or version. The order of its motor list is the order of actions, so it is the place
in the list that says which joint a motor drives; ids only usually agree. What it says and `robot.toml` has no word for
stays in a copy of the file in the robot's folder, from which the export starts.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.files import read_json, write_bytes
from openant_tools.numbers import literal, number
from openant_tools.robot.config import MAX_ANGLE_RAD, MAX_OFFSET_RAD, Provenance, RobotConfig, read_document
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES, JOINTS

__all__ = [
    "PlatformConfig", "export_notes", "export_platform_config", "import_platform_config", "imported_object",
    "read_platform_config",
]  # fmt: skip

#: The platform's config maker rounds offsets to this grid, the angle between two splines of a servo's horn it knows.
OFFSET_GRID_RAD = math.pi / 4
#: Digits that survive degrees → rad → degrees.
DEGREE_DIGITS = 12
#: What the platform's driver speaks, whatever its configuration says.
PLATFORM_BAUD = 1_000_000


@dataclass(frozen=True)
class PlatformConfig:
    """An `antNN.json` in our terms.

    Attributes:
        path: the file.
        name: the file's stem.
        values: dotted path of `robot.toml` → value, for every key that was there.
        notes: what its owner should know: odd ids, offsets off the grid, a tag that contradicts the file's name.
        raw: the object as it stands in the file.
    """

    path: Path
    name: str
    values: Mapping[str, Any]
    notes: tuple[str, ...]
    raw: Mapping[str, Any]


def _number(value: Any, where: str, low: float, high: float, unit: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput("is no number", where=where)
    if not low <= value <= high:
        remedy = f"{literal(low, 4)} to {literal(high, 4)}"
        if unit == "rad" and math.radians(abs(value)) <= high:
            remedy = f"if degrees were meant write {literal(math.radians(value))}"
        raise BadInput(f"{literal(value)} {unit} cannot be", where=where, remedy=remedy)
    return float(value)


def _whole(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadInput("is no whole number", where=where)
    return value


def _load(path: Path) -> dict[str, Any]:
    try:
        raw = read_json(path, "is the file cut short?")
    except FileNotFoundError:
        raise BadInput("there is no such file", where=path) from None
    if not isinstance(raw, dict):
        raise BadInput("is no JSON object", where=path, remedy="the platform's configuration is one flat object")
    return raw


def read_platform_config(path: str | Path) -> PlatformConfig:
    """Read an `antNN.json`; keys may be missing, and unknown ones are kept in `raw`.

    Raises:
        BadInput: no JSON object, no list of eight motors, or a value that cannot be.
    """
    path = Path(path)
    raw = _load(path)
    values: dict[str, Any] = {}
    notes: list[str] = []

    for key, target in (("motor_port", "ports.bus"), ("imu_port", "ports.imu"), ("camera_id", "ports.camera")):
        if raw.get(key) is not None:
            if isinstance(raw[key], bool) or not isinstance(raw[key], str | int):
                raise BadInput("is neither a path nor a number", where=f"{path}, {key}")
            values[target] = raw[key]
    if raw.get("motor_baudrate") is not None:
        values["bus.baud"] = _whole(raw["motor_baudrate"], f"{path}, motor_baudrate")
    _read_motors(raw.get("motor_list"), path, values, notes)

    if raw.get("camera_fov_diagonal_deg") is not None:
        degrees = _number(raw["camera_fov_diagonal_deg"], f"{path}, camera_fov_diagonal_deg", 6, 171, "°")
        values["camera.fov_diagonal_rad"] = math.radians(degrees)
    for key, field in (("camera_tag_sizes", "size_m"), ("camera_tag_ids", "id")):
        table = raw.get(key)
        if table is None:
            continue
        if not isinstance(table, dict):
            raise BadInput("is no object", where=f"{path}, {key}")
        for tag in ("origin", "body"):
            if table.get(tag) is not None:
                where = f"{path}, {key}.{tag}"
                value = _whole(table[tag], where) if field == "id" else _number(table[tag], where, 0.005, 2, "m")
                values[f"camera.{tag}_tag_{field}"] = value
    _read_name(path, values, notes)
    return PlatformConfig(path, path.stem, values, tuple(notes), raw)


def _read_motors(motors: Any, path: Path, values: dict[str, Any], notes: list[str]) -> None:
    if not isinstance(motors, list):
        raise BadInput(
            "has no list motor_list", where=path, remedy="is this a robot's configuration? Its name is antNN.json"
        )
    if len(motors) != len(JOINT_NAMES):
        raise BadInput(f"motor_list has {len(motors)} motors", where=path, remedy=f"an Open Ant has {len(JOINT_NAMES)}")
    for index, (joint, motor) in enumerate(zip(JOINTS.values(), motors, strict=True)):
        where = f"{path}, motor_list[{index}]"
        if not isinstance(motor, dict):
            raise BadInput("is no object", where=where)
        ranges = {"offset": MAX_OFFSET_RAD, "min_position": MAX_ANGLE_RAD, "max_position": MAX_ANGLE_RAD}
        names = {"offset": "zero_offset_rad", "min_position": "min_rad", "max_position": "max_rad"}
        if motor.get("id") is not None:
            values[f"motors.{joint.name}.id"] = id = _whole(motor["id"], f"{where}.id")
            if id != joint.id:
                notes.append(
                    f"{joint.name} has id {id} (place {index} of the list); the platform's guide gives it {joint.id}"
                )
        for key, limit in ranges.items():
            if motor.get(key) is not None:
                values[f"motors.{joint.name}.{names[key]}"] = _number(
                    motor[key], f"{where}.{key}", -limit, limit, "rad"
                )
        offset = values.get(f"motors.{joint.name}.zero_offset_rad")
        if offset is not None and off_grid(offset) > 1e-4:
            notes.append(
                f"the offset of {joint.name}, {literal(offset)} rad, is {number(off_grid(offset), 'rad')} off the "
                "multiples of 45° that the platform's config maker writes"
            )


def _read_name(path: Path, values: dict[str, Any], notes: list[str]) -> None:
    """The file's name carries the body's tag: ant12.json is the robot with tag 12."""
    match = re.fullmatch(r"ant(\d+)", path.stem)
    if match is None:
        return
    tag = int(match[1])
    stated = values.setdefault("camera.body_tag_id", tag)
    if stated != tag:
        notes.append(f"the file's name says body tag {tag}, camera_tag_ids.body says {stated}; the latter is taken")


def import_platform_config(platform: PlatformConfig, path: str | Path, kit: str | None = None) -> RobotFolder:
    """Put a platform's configuration into a robot's folder, which is made where there is none.

    A copy of its object stays in the folder; `platform.config` in `robot.toml` names it.

    Args:
        platform: what was read.
        path: the robot's folder.
        kit: of a robot to be made; default "standard", which the file cannot tell.

    Raises:
        BadInput: the folder's robot is of another kit, or what it would hold cannot be.
    """
    source = Provenance(
        how="imported",
        command=f"openant config import {platform.path.name}",
        date=datetime.datetime.now(datetime.UTC).replace(microsecond=0),
    )
    # What every joint got has one entry with *, instead of eight alike.
    fields = {key.split(".")[2] for key in platform.values if key.startswith("motors.")}
    for_all = {field for field in fields if all(f"motors.{joint}.{field}" in platform.values for joint in JOINTS)}
    keys = [key for key in platform.values if not (key.startswith("motors.") and key.split(".")[2] in for_all)]
    provenance = dict.fromkeys([*keys, *(f"motors.*.{field}" for field in sorted(for_all))], source)

    folder = RobotFolder(Path(path))
    copy = folder.path / f"{platform.name}.json"
    values = {**platform.values, "platform.config": copy.name}
    if folder.config_file.is_file():
        present = folder.config().kit
        if kit not in (None, present):
            raise BadInput(
                f"the robot there is of the {present} kit", where=folder.config_file, remedy="leave out --kit"
            )
        folder.update(values, provenance=provenance)
    else:
        create_robot(path, kit or "standard", platform.name, values=values, provenance=provenance)
    if copy.resolve() != platform.path.resolve():
        write_bytes(copy, json.dumps(platform.raw, indent=4, ensure_ascii=False).encode("utf-8"))
    return folder


def imported_object(folder: RobotFolder) -> dict[str, Any] | None:
    """The object that was imported into a folder, None where none was, or where its copy is gone."""
    document = read_document(folder.config_file.read_bytes(), folder.config_file)
    table = document.get("platform")
    name = table.get("config") if isinstance(table, dict) else None
    path = folder.path / name if isinstance(name, str) else None
    return _load(path) if path is not None and path.is_file() else None


def export_notes(config: RobotConfig, out: Path | None, *, on_grid: bool = False) -> list[str]:
    """What the platform's software will take otherwise than it stands in `robot.toml`."""
    notes = []
    worst = max(config.motors.values(), key=lambda motor: off_grid(motor.zero_offset_rad))
    if on_grid and off_grid(worst.zero_offset_rad) > 1e-4:
        notes.append(
            f"rounding to 45° moves the zero of {worst.joint} by {number(off_grid(worst.zero_offset_rad), 'rad')}, "
            "the most of all joints"
        )
    if config.bus.baud != PLATFORM_BAUD:
        notes.append(f"the platform's environment ignores motor_baudrate and speaks {PLATFORM_BAUD} baud")
    tag = config.camera.body_tag_id
    if out is not None and tag >= 0 and out.name != f"ant{tag}.json":
        notes.append(f"the platform names its files after the tag on the torso, here ant{tag}.json")
    return notes


def off_grid(offset_rad: float) -> float:
    """rad between an offset and the nearest multiple of 45°."""
    return abs(offset_rad - round(offset_rad / OFFSET_GRID_RAD) * OFFSET_GRID_RAD)


def export_platform_config(
    config: RobotConfig, base: Mapping[str, Any] | None = None, *, on_grid: bool = False
) -> dict[str, Any]:
    """The object of an `antNN.json` for the platform's software.

    Args:
        config: the robot.
        base: the object that was imported; keys without a word in `robot.toml` are taken from it, in its order.
        on_grid: round zero offsets to multiples of 45°, as the platform's config maker would.

    Raises:
        BadInput: a servo runs in reverse, which the platform's configuration cannot say.
    """
    reversed_joints = [motor.joint for motor in config.motors.values() if motor.direction < 0]
    if reversed_joints:
        raise BadInput(
            f"{', '.join(reversed_joints)} turn in reverse (direction = -1), which the platform's file cannot say",
            remedy="set bit 0 of their drive_mode register instead, or mount them as the platform's guide shows",
        )
    out = dict(base or {})

    def put(target: dict[str, Any], key: str, value: Any) -> None:
        # Numbers that mean the same stay as they were written, 60 and not 60.0.
        if key not in target or isinstance(target[key], bool) or target[key] != value:
            target[key] = value

    put(out, "motor_port", config.ports.bus)
    listed = out.get("motor_list")
    old = listed if isinstance(listed, list) and len(listed) == len(JOINT_NAMES) else [{}] * len(JOINT_NAMES)
    motors: list[dict[str, Any]] = []
    for motor, entry in zip(config.motors.values(), old, strict=True):
        new = dict(entry) if isinstance(entry, dict) else {}
        offset = motor.zero_offset_rad
        put(new, "id", motor.id)
        put(new, "min_position", motor.min_rad)
        put(new, "max_position", motor.max_rad)
        put(new, "offset", round(offset / OFFSET_GRID_RAD) * OFFSET_GRID_RAD if on_grid else offset)
        motors.append(new)
    out["motor_list"] = motors
    put(out, "motor_baudrate", config.bus.baud)
    put(out, "imu_port", config.ports.imu)
    camera = config.ports.camera
    if camera != "" or "camera_id" not in out:
        put(out, "camera_id", 0 if camera == "" else camera)
    put(out, "camera_fov_diagonal_deg", round(math.degrees(config.camera.fov_diagonal_rad), DEGREE_DIGITS))
    sizes, ids = dict(out.get("camera_tag_sizes") or {}), dict(out.get("camera_tag_ids") or {})
    put(sizes, "origin", config.camera.origin_tag_size_m)
    put(sizes, "body", config.camera.body_tag_size_m)
    put(ids, "origin", config.camera.origin_tag_id)
    if config.camera.body_tag_id >= 0:
        put(ids, "body", config.camera.body_tag_id)
    out["camera_tag_sizes"], out["camera_tag_ids"] = sizes, ids
    return out
