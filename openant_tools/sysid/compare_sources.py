"""Where snapshots come from: a fit, a finding, a robot's folder now or as it was on a date."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.files import read_json, read_toml, reading
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.robot.folder import RobotFolder
from openant_tools.sysid.compare import Estimate, Snapshot
from openant_tools.sysid.parameter import KINDS

__all__ = ["snapshot"]

#: tables of robot.toml that hold what was identified and measured
_TABLES = ("identified", "bench")
#: what verdicts were called in files of before
_FORMER = {"identifiable": "identified", "undetermined": "not in the data"}


def snapshot(source: str, robot: RobotFolder | None = None) -> Snapshot:
    """The snapshot that a user names.

    Args:
        source: a fit.json or finding, a folder with a fit.json, a robot's folder (as it is now), or a date such as
            2026-03-01 (or with a time) of `robot`: the newest that was measured until then.

    Raises:
        BadInput: there is no such thing, or nothing was identified in it.
    """
    path = Path(source)
    if path.is_file() and path.name != CONFIG_NAME:
        return _read_json(path)
    if path.name == CONFIG_NAME or (path / CONFIG_NAME).is_file():
        return _at(RobotFolder.at(path), None, str(path))
    if (path / "fit.json").is_file():
        return _read_json(path / "fit.json")
    until = _date(source)
    if until is not None:
        if robot is None:
            raise BadInput(f"{source} is a date of which robot?", remedy="add --robot DIR")
        return _at(robot, until, source)
    raise BadInput(
        "is no fit, no robot's folder and no date",
        where=source,
        remedy="name a fit.json, a folder that holds one, a robot's folder, or a date such as 2026-03-01 with --robot",
    )


def _date(text: str) -> datetime.datetime | None:
    """The last moment that a date or time names, UTC where it says no zone."""
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    day_only = "T" not in text and " " not in text and ":" not in text
    return moment + datetime.timedelta(days=1, microseconds=-1) if day_only else moment


def _read_json(path: Path) -> Snapshot:
    content = read_json(path, "name a fit.json")
    parameters = _parameters(content, path)
    if not parameters:
        raise BadInput("holds no parameters", where=path, remedy="name the fit.json that `openant sysid fit` wrote")
    with reading(path, "it is no fit.json", "name the fit.json that `openant sysid fit` wrote"):
        return Snapshot(str(path), parameters, tuple(map(str, content.get("runs", ()))))


def _parameters(content: Any, path: Path) -> dict[str, Estimate]:
    """The parameters of a fit.json or of a finding; empty where it has none."""
    table = content.get("parameters") if isinstance(content, Mapping) else None
    if not isinstance(table, Mapping):
        return {}
    date = _moment(content.get("date"))
    out: dict[str, Estimate] = {}
    for name, entry in table.items():
        try:
            joints = tuple(map(str, entry.get("joints", ())))
            value, low, high = float(entry["value"]), _number(entry["low"]), _number(entry["high"])
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            raise BadInput(f"{name} has no value, low and high", where=path, remedy="is it a fit.json?") from None
        if not math.isfinite(value):
            raise BadInput(f"{name} is {value}", where=path)
        out[str(name)] = Estimate(
            value, low, high, str(entry.get("unit", "")), _word(entry.get("verdict", "")), joints, date
        )
    return out


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _word(value: Any) -> str:
    return _FORMER.get(str(value), str(value))


def _moment(value: Any) -> datetime.datetime | None:
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value)
        except ValueError:
            return None
    if not isinstance(value, datetime.datetime):
        return None
    return value if value.tzinfo else value.replace(tzinfo=datetime.UTC)


def _at(robot: RobotFolder, until: datetime.datetime | None, name: str) -> Snapshot:
    """Every parameter's newest estimate until then, from findings, robot.toml and the files that stood before it."""
    newest: dict[str, Estimate] = {}
    for parameter, estimate in _history(robot):
        if estimate.date is None or (until is not None and estimate.date > until):
            continue
        present = newest.get(parameter)
        # Of two of one moment the finding, which comes first, knows more: units and verdicts.
        if present is None or present.date is None or estimate.date > present.date:
            newest[parameter] = estimate
    if not newest:
        when = f" until {name}" if until is not None else ""
        raise BadInput(
            f"nothing was identified{when}",
            where=robot.path,
            remedy="`openant sysid fit … --robot DIR` puts what it finds into the robot's folder",
        )
    return Snapshot(name, newest)


def _history(robot: RobotFolder) -> Iterator[tuple[str, Estimate]]:
    for path in sorted(robot.findings.rglob("*.json")):
        try:
            content = read_json(path)
            parameters = _parameters(content, path)
        except (OSError, BadInput):
            continue  # a finding of another kind, or one that was cut
        written = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)
        for name, estimate in parameters.items():
            yield name, estimate if estimate.date is not None else replace(estimate, date=written)
    for path in [*sorted(robot.backups.glob("robot-*.toml")), robot.config_file]:
        try:
            table = read_toml(path, "`openant config check` says more")
        except (OSError, BadInput):
            if path == robot.config_file:
                raise
            continue
        yield from _of_table(table)


def _of_table(table: Mapping[str, Any]) -> Iterator[tuple[str, Estimate]]:
    """`identified.*` and `bench.*` of a robot.toml, with the intervals of their provenance."""
    provenance = table.get("provenance", {})
    for top in _TABLES:
        for key, value in _leaves(table.get(top, {})):
            source = provenance.get(f"{top}.{key}", {})
            kind = KINDS.get(key.partition(".")[0])
            yield (
                key,
                Estimate(
                    value,
                    _number(source.get("low")),
                    _number(source.get("high")),
                    "" if kind is None else kind.unit,
                    _word(source.get("how", "")),
                    date=_moment(source.get("date")),
                ),
            )


def _leaves(table: Any, front: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(table, Mapping):
        for key, value in table.items():
            yield from _leaves(value, f"{front}.{key}" if front else str(key))
    elif isinstance(table, int | float) and not isinstance(table, bool):
        yield front, float(table)
