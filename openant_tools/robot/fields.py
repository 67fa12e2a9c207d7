"""Fields of `robot.toml` as data: what each may hold, and the words for what it may not.

A frozen dataclass declares its fields with `number`, `whole`, `text` … ; `read` turns a TOML table into an instance and
lists everything that does not fit, instead of stopping at the first.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from typing import Any, Literal, TypeVar

from openant_tools.numbers import literal

__all__ = ["ConfigProblem", "choice", "number", "port", "read", "stranger", "switch", "text", "vector", "whole"]

T = TypeVar("T")


@dataclass(frozen=True)
class ConfigProblem:
    """Something in a configuration that cannot be, or (a note) that is probably not meant.

    Attributes:
        key: the dotted path of the value, such as `motors.hip_rr.id`.
        what: what is wrong.
        remedy: what to do.
        severity: "error", or "note" for what does not keep the configuration from being used.
    """

    key: str
    what: str
    remedy: str | None = None
    severity: Literal["error", "note"] = "error"

    @property
    def place(self) -> str:
        """The key for people: one line, whatever its owner put between quotes."""
        return self.key if self.key.isprintable() else repr(self.key)


class Unfit(Exception):
    """A value that a field cannot hold."""

    def __init__(self, what: str, remedy: str | None = None) -> None:
        self.what = what
        self.remedy = remedy
        super().__init__(what)


Parse = Callable[[Any], Any]


def _field(parse: Parse, default: Any, key: str | None = None) -> Any:
    metadata = {"parse": parse, "key": key}
    if isinstance(default, dict | list):
        raise TypeError("a mutable default would be shared")
    return (
        dataclasses.field(metadata=metadata)
        if default is MISSING
        else dataclasses.field(default=default, metadata=metadata)
    )


def _a(value: Any) -> str:
    """What a TOML value is, in words."""
    kinds: tuple[tuple[type, str], ...] = (
        (bool, "true or false"), (int, "a whole number"), (float, "a number"), (str, "text"), (list, "a list"),
        (dict, "a table"),
    )  # fmt: skip
    return next((words for kind, words in kinds if isinstance(value, kind)), "a date")


def _parse_number(low: float, high: float, unit: str, or_zero: bool = False) -> Parse:
    def parse(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            remedy = "leave out the quotes" if isinstance(value, str) else None
            raise Unfit(f"is {_a(value)}, but a number is needed{f' ({unit})' if unit else ''}", remedy)
        number = float(value)
        if not low <= number <= high and not (or_zero and number == 0):
            remedy = f"give {'0, or ' if or_zero else ''}a value from {literal(low)} to {literal(high)}{f' {unit}' if unit else ''}"
            if unit == "rad" and math.isfinite(number) and low <= math.radians(number) <= high:
                remedy = f"angles stand in rad; if degrees were meant write {literal(math.radians(number))}"
            raise Unfit(f"{literal(number)}{f' {unit}' if unit else ''} cannot be", remedy)
        return number

    return parse


def number(
    low: float, high: float, unit: str = "", default: Any = MISSING, key: str | None = None, *, or_zero: bool = False
) -> Any:
    """A finite number from low to high (or 0), in `unit`; `key` where the TOML name differs from the field's."""
    return _field(_parse_number(low, high, unit, or_zero), default, key)


def whole(low: int, high: int, default: Any = MISSING) -> Any:
    """A whole number from low to high."""

    def parse(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise Unfit(f"is {_a(value)}, but a whole number is needed")
        if not low <= value <= high:
            raise Unfit(f"{value} cannot be", f"give a whole number from {low} to {high}")
        return value

    return _field(parse, default)


def text(default: Any = MISSING, key: str | None = None) -> Any:
    """A string on one line."""

    def parse(value: Any) -> str:
        if not isinstance(value, str):
            raise Unfit(f"is {_a(value)}, but text is needed", "put it into quotes")
        if "\n" in value or "\0" in value:
            raise Unfit("holds a line break")
        return value

    return _field(parse, default, key)


def switch(default: Any = MISSING, key: str | None = None) -> Any:
    """true or false."""

    def parse(value: Any) -> bool:
        if not isinstance(value, bool):
            raise Unfit(f"is {_a(value)}, but true or false is needed")
        return value

    return _field(parse, default, key)


def choice(options: Sequence[Any], what: str, default: Any = MISSING) -> Any:
    """One of a few values; `what` they are, for the message."""

    def parse(value: Any) -> Any:
        for option in options:
            # True equals 1 in Python, but not in a configuration.
            if value == option and isinstance(value, bool) == isinstance(option, bool):
                return option
        listed = ", ".join(str(option) for option in options)
        close = difflib.get_close_matches(value, list(map(str, options)), n=1) if isinstance(value, str) else []
        raise Unfit(f"{value!r} is no {what}", f"did you mean {close[0]!r}?" if close else f"use one of {listed}")

    return _field(parse, default)


def port() -> Any:
    """The path of a device, or the number of a camera; empty while it is not known."""

    def parse(value: Any) -> str | int:
        if isinstance(value, bool) or not isinstance(value, str | int) or (isinstance(value, int) and value < 0):
            raise Unfit(f"is {_a(value)}, but the path of a device or the number of a camera is needed")
        return value

    return _field(parse, "")


def vector(size: int, low: float, high: float, unit: str = "", default: Any = MISSING) -> Any:
    """`size` numbers from low to high, in `unit`."""
    element = _parse_number(low, high, unit)

    def parse(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != size:
            count = f"has {len(value)} of them" if isinstance(value, list) else f"is {_a(value)}"
            raise Unfit(f"{count}, but a list of {size} numbers is needed")
        return tuple(element(number) for number in value)

    return _field(parse, default)


def stranger(path: str, key: str, known: Sequence[str]) -> ConfigProblem:
    """The note about a key that nobody reads: it stays in the file, and does nothing."""
    close = difflib.get_close_matches(key, list(known), n=1, cutoff=0.8)
    return ConfigProblem(
        path, f"is not known; is {close[0]!r} meant?" if close else "is not known: nothing reads it", None, "note"
    )


def read(kind: type[T], table: Any, path: str, problems: list[ConfigProblem], **given: Any) -> T | None:
    """An instance of the dataclass `kind` from a TOML table, or None where a field stayed empty.

    Args:
        kind: a dataclass; fields declared by this module are read, others are taken from `given`.
        table: the TOML value at `path`; anything but a table is a problem.
        path: the dotted path of the table, "" for the document.
        problems: everything that does not fit is appended here.
    """

    def full(key: str) -> str:
        return f"{path}.{key}" if path else key

    if not isinstance(table, Mapping):
        problems.append(ConfigProblem(path, f"is {_a(table)}, but a table is needed"))
        return None
    declared = {field.metadata.get("key") or field.name: field for field in dataclasses.fields(kind) if field.metadata}  # type: ignore[arg-type]
    strangers = [key for key in table if key not in declared]
    values = dict(given)
    whole_instance = True
    for key, field in declared.items():
        slip = difflib.get_close_matches(key, strangers, n=1, cutoff=0.8)
        if key in table:
            try:
                values[field.name] = field.metadata["parse"](table[key])
            except Unfit as unfit:
                problems.append(ConfigProblem(full(key), unfit.what, unfit.remedy))
                whole_instance = False
        elif field.default is MISSING:
            problems.append(
                ConfigProblem(full(key), "is missing", f"is {full(slip[0])!r} a slip of it?" if slip else None)
            )
            whole_instance = False
    named = list(given) + [field.name for field in dataclasses.fields(kind) if not field.metadata]  # type: ignore[arg-type]
    if path:
        problems += [stranger(full(key), key, list(declared)) for key in strangers if key not in named]
    return kind(**values) if whole_instance else None
