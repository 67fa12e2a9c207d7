"""A plan as a file: the recordings and segments that `openant sysid record --plan` plays, in TOML for people to change."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import tomlkit

from openant_tools.errors import BadInput
from openant_tools.files import read_toml, write_text
from openant_tools.numbers import exact, literal, number
from openant_tools.sysid import excitation, floor_motion
from openant_tools.sysid.excitation import Segment
from openant_tools.sysid.protocols import LONGEST_S, Protocol

__all__ = ["SEGMENTS", "as_table", "read_plan", "write_plan"]

SCHEMA = "openant.plan/1"

#: kind → class
SEGMENTS: Mapping[str, type[Segment]] = {
    kind.__name__: kind
    for kind in (
        excitation.Rest, excitation.Chirp, excitation.Steps, excitation.Holds, excitation.SlowReversals,
        excitation.Multisine, excitation.Sine, excitation.Square, excitation.InTurn, excitation.Around,
        excitation.Releases, floor_motion.WeightShifts, floor_motion.LegLifts, floor_motion.Scrub, floor_motion.Gait,
        floor_motion.PushUps, floor_motion.Twitch,
    )
}  # fmt: skip


def write_plan(path: Path, protocols: tuple[Protocol, ...], comment: str) -> None:
    """Write what is to be recorded; `comment` says where it comes from."""
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line))
    document["schema"] = SCHEMA
    document["name"], document["words"] = protocols[0].name, protocols[0].words
    recordings = tomlkit.aot()
    for protocol in protocols:
        recording = tomlkit.table()
        recording["setup"] = protocol.setup
        if protocol.heading_rad:
            recording["heading_rad"] = protocol.heading_rad
        segments = tomlkit.aot()
        for segment in protocol.segments:
            table = tomlkit.table()
            for key, value in as_table(segment).items():
                inner = tomlkit.inline_table()
                if isinstance(value, dict):
                    inner.update(value)
                table[key] = inner if isinstance(value, dict) else value
            segments.append(table)
        recording["segment"] = segments
        recordings.append(recording)
    document["recording"] = recordings
    write_text(path, tomlkit.dumps(document))


def read_plan(path: Path) -> tuple[Protocol, ...]:
    """The recordings that a plan asks for; raises BadInput, which names the place."""
    try:
        table = read_toml(path, "mend it there; a plan is TOML")
    except OSError as error:
        raise BadInput(error.strerror or str(error), where=path, remedy="name a plan file") from None
    if table.get("schema") != SCHEMA:
        raise BadInput(
            f"is no plan: its schema is not {SCHEMA!r}", where=path, remedy="make one with `openant sysid plan --out`"
        )
    recordings = table.get("recording")
    if not isinstance(recordings, list) or not recordings:
        raise BadInput("has no [[recording]]", where=path, remedy="make it anew with `openant sysid plan --out`")
    return tuple(
        _recording(entry, f"{path}, recording {number}", str(table.get("name", path.stem)), str(table.get("words", "")))
        for number, entry in enumerate(recordings, 1)
    )


def _recording(entry: Any, where: str, name: str, words: str) -> Protocol:
    setup = entry.get("setup") if isinstance(entry, dict) else None
    if setup not in ("stand", "floor"):
        raise BadInput("`setup` is not stand or floor", where=where, remedy='write setup = "stand"')
    heading = _number(entry.get("heading_rad", 0.0), "heading_rad", where)
    segments = entry.get("segment")
    if not isinstance(segments, list) or not segments:
        raise BadInput("has no [[recording.segment]]", where=where, remedy="add one with kind and seconds")
    read = tuple(_segment(table, f"{where}, segment {number}") for number, table in enumerate(segments, 1))
    if setup == "stand" and any(isinstance(segment, _FLOOR) for segment in read):
        raise BadInput("has a motion for the floor on the stand", where=where, remedy='write setup = "floor"')
    if setup == "floor" and any(_releases(segment) for segment in read):
        raise BadInput("lets go of legs that carry the robot", where=where, remedy='write setup = "stand"')
    made = Protocol(name, words, read, setup, heading)
    if made.seconds > LONGEST_S:
        raise BadInput(
            f"takes {number(made.seconds, 's')}", where=where, remedy=f"keep it below {exact(LONGEST_S, 's')}"
        )
    return made


_FLOOR = (
    floor_motion.WeightShifts, floor_motion.LegLifts, floor_motion.Scrub, floor_motion.Gait, floor_motion.PushUps,
    floor_motion.Twitch,
)  # fmt: skip


def _releases(segment: Segment) -> bool:
    inner = getattr(segment, "of", None)
    return isinstance(segment, excitation.Releases) or (inner is not None and _releases(inner))


def _segment(table: Any, where: str) -> Segment:
    kind = table.get("kind") if isinstance(table, dict) else None
    if not isinstance(kind, str) or kind not in SEGMENTS:
        near = difflib.get_close_matches(str(kind), list(SEGMENTS), n=1)
        remedy = f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(SEGMENTS)}"
        raise BadInput(f"there is no motion {kind!r}", where=where, remedy=remedy)
    cls = SEGMENTS[kind]
    known = {field.name: field for field in fields(cls)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "kind":
            continue
        if key not in known:
            raise BadInput(f"{kind} knows no {key!r}", where=where, remedy=f"use {', '.join(known)}")
        values[key] = _value(known[key].type, key, value, where)
    missing = [key for key in ("seconds", "of") if key in known and key not in values]
    if missing:
        raise BadInput(f"{kind} lacks `{missing[0]}`", where=where, remedy="add it")
    return cls(**values)


def _value(kind: Any, key: str, value: Any, where: str) -> Any:
    """A field's value, checked by its type and by what its name says it is."""
    if kind == "Segment":
        return _segment(value, f"{where}, of")
    if kind == "bool":
        if not isinstance(value, bool):
            raise BadInput(f"`{key}` is not true or false", where=where, remedy="correct it")
        return value
    if kind == "int":
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 1000:
            raise BadInput(f"`{key}` is not a whole number from 1 on", where=where, remedy="correct it")
        return value
    if kind.startswith("tuple"):
        items = tuple(_number(item, key, where) for item in (value if isinstance(value, list) else [value]))
        if not items or any(abs(item) >= 1 for item in items):
            raise BadInput(f"`{key}` are not shares between -1 and 1", where=where, remedy="correct them")
        return items
    given = _number(value, key, where)
    if key.endswith("share") and not 0 < given <= 1:
        raise BadInput(f"`{key}` is {literal(given)}, not a share between 0 and 1", where=where, remedy="correct it")
    if given <= 0:
        raise BadInput(f"`{key}` is {literal(given)}, it must be more than 0", where=where, remedy="correct it")
    return given


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadInput(f"`{key}` is not a number", where=where, remedy="correct it")
    return float(value)


def as_table(segment: Segment) -> dict[str, Any]:
    """A segment as plain numbers, as it stands in a plan and in the facts of a recording."""
    out: dict[str, Any] = {"kind": type(segment).__name__}
    for field in fields(segment):
        value = getattr(segment, field.name)
        if isinstance(value, Segment):
            out[field.name] = as_table(value)
        elif isinstance(value, float):
            out[field.name] = round(value, 4)
        else:
            out[field.name] = list(value) if isinstance(value, tuple) else value
    return out
