"""The facts of a run as JSON (formats, section 1): read, checked, written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.files import parse_json
from openant_tools.recording.run import Facts

__all__ = ["facts_from_json", "facts_to_json", "with_facts"]

_TEXTS = ("setup", "protocol", "repeat_of", "model", "notes")
_NUMBERS = ("heading_rad", "supply_v", "ambient_c")
_KNOWN = tuple(field.name for field in fields(Facts) if field.name != "extra")


def facts_from_json(text: str, where: str) -> Facts:
    """The facts in `text`; keys that are not ours go to `extra` as they are.

    Args:
        text: a JSON object.
        where: the file's name, for the message.

    Raises:
        BadInput: not JSON, no `joints`, or a value of the wrong kind.
    """
    data = parse_json(text, where)
    if not isinstance(data, dict):
        raise BadInput("the facts of a run are a JSON object", where=where, remedy='start with {"joints": [...]}')
    if "joints" not in data:
        raise BadInput(
            "`joints` is missing", where=where, remedy='name them in order, as in "joints": ["hip_rr", "knee_rr"]'
        )
    values: dict[str, Any] = {"joints": _joints(data["joints"], where)}
    for key in _TEXTS:
        if data.get(key) is not None:
            values[key] = _kind(data[key], str, key, "a text", where)
    for key in _NUMBERS:
        if data.get(key) is not None:
            values[key] = _number(data[key], key, where)
    for key, kind in (("motors", str), ("resolution", float)):
        if data.get(key) is not None:
            table = _kind(data[key], dict, key, "an object", where)
            values[key] = {
                name: _kind(value, str, f"{key}.{name}", "a servo model's name", where)
                if kind is str
                else _number(value, f"{key}.{name}", where)
                for name, value in table.items()
            }
    if data.get("registers") is not None:
        registers = _kind(data["registers"], dict, "registers", "an object (joint → settings)", where)
        values["registers"] = {
            joint: {
                name: _number(value, f"registers.{joint}.{name}", where)
                for name, value in _kind(table, dict, f"registers.{joint}", "an object", where).items()
            }
            for joint, table in registers.items()
        }
    return Facts(**values, extra={key: value for key, value in data.items() if key not in _KNOWN})


def facts_to_json(facts: Facts) -> str:
    """The same as an indented JSON object; what is not known is left out."""
    data = {name: _plain(getattr(facts, name)) for name in _KNOWN}
    known = {name: value for name, value in data.items() if name == "joints" or value not in (None, {})}
    return json.dumps(known | _plain(facts.extra), indent=1, ensure_ascii=False) + "\n"


def with_facts(facts: Facts, more: Mapping[str, Any], where: str) -> Facts:
    """The facts with `more` of them, by the keys of their JSON; each takes the place of what was there.

    Raises:
        BadInput: a value of the wrong kind.
    """
    known = json.loads(facts_to_json(facts)) | _plain(more)
    return facts_from_json(json.dumps(known, default=str), where)  # a path is a text there


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):  # a NumPy number
        return value.item()
    return value


def _joints(value: Any, where: str) -> tuple[str, ...]:
    if (
        not isinstance(value, list)
        or not value
        or not all(isinstance(name, str) and name and name.isprintable() for name in value)
    ):
        raise BadInput("`joints` is not a list of names", where=where, remedy='write "joints": ["hip_rr", "knee_rr"]')
    twice = sorted({name for name in value if value.count(name) > 1})
    if twice:
        raise BadInput(f"`joints` names {', '.join(twice)} twice", where=where, remedy="name each joint once")
    return tuple(value)


def _kind(value: Any, kind: type, key: str, what: str, where: str) -> Any:
    if not isinstance(value, kind):
        raise BadInput(
            f"`{key}` is {json.dumps(value)[:40]}, not {what}", where=where, remedy="correct or drop the key"
        )
    return value


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadInput(
            f"`{key}` is {json.dumps(value)[:40]}, not a number", where=where, remedy="correct or drop the key"
        )
    return value
