"""Every number that people read comes from one place, with the digits that it deserves."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator

import pytest
from places import TESTS
from readable import unreadable
from sources import modules

from openant_tools.comms.hardware import changes
from openant_tools.numbers import chosen, column, exact, literal, number, percent, span
from openant_tools.procedure.journal import EepromWrite


@pytest.mark.parametrize(
    ("value", "unit", "low", "high", "name", "shown"),
    [
        (0.000487, "rad", None, None, "error after", "0.49 mrad"),
        (1.776e-15, "rad", None, None, "residual of hip_rr", "0.00 mrad"),
        (0.7853981634, "rad", None, None, "mounting", "45.0°"),
        (0.21, "rad", 0.2, 0.22, "nudge", "12.0° (11.5 to 12.6)"),
        (0.00063, "s", None, None, "round trip", "0.630 ms"),
        (12.03, "s", 11.0, 13.0, "to its limit", "12.0 s (11.0 to 13.0)"),
        (4.7213, "N·m/rad", 4.61, 4.84, "stiffness", "4.72 N·m/rad (4.61 to 4.84)"),
        (0.0, "1", None, None, "telemetry errors", "0"),
        (0.0, "s", 0.0, 0.0011, "action delay", "0.0 ms (0.0 to 1.1)"),
        (1780.0, "", None, None, "answers asked for", "1780"),
        (0.93812, "1", None, None, "scale", "0.938"),
        (-0.04, "V", None, None, "", "−0.0400 V"),
        (None, "rad", None, None, "", "unknown"),
        (math.nan, "V", 1.0, 2.0, "", "unknown"),
        (1.5, "K", None, 3.0, "", "1.50 K"),
    ],
)
def test_a_number_is_read_in_the_unit_and_with_the_digits_that_it_deserves(value, unit, low, high, name, shown):
    assert number(value, unit, low, high, name=name) == shown


def test_columns_signs_and_shares():
    assert number(0.1, "rad", sign=True, decimals=1) == "+5.7°"
    assert number(-1e-9, "rad", sign=True, decimals=1) == "+0.0°"
    assert span(-math.pi / 4, math.pi / 4, "rad") == "−45 to 45°"
    assert span(5, 60, "s") == "5 to 60 s"
    assert span(0.00011, 0.00019, "kg·m²") == "0.00011 to 0.00019 kg·m²"
    assert column((0.1, 0.045, None), "m") == ["0.100 m", "0.045 m", "unknown"]
    assert column((0.02, 0.045), "m") == ["20 mm", "45 mm"]
    assert exact(0.5, "s") == "0.5 s"
    assert exact(1_000_000, "baud") == "1000000 baud"
    assert (literal(-0.7853981634), literal(3.0), literal(1.23456, 4)) == ("-0.785398", "3", "1.235")
    assert (chosen(0.005, "share"), chosen(math.radians(2), "rad")) == ("0.5 %", "2°")
    assert [percent(share) for share in (0.0, 0.0004, 0.06, 1.0, None)] == [
        "0 %",
        "below 1 %",
        "6 %",
        "100 %",
        "unknown",
    ]


#: formats of what is no number: of words (their width, or where they are cut), of names of files and devices, of dates
OF_NO_NUMBER = re.compile(r"([^0-9]?[<>^])?(\d*|(\d+)\.\3)|0\d+[dx]|(%[A-Za-z].?)+")
#: what makes a list or a number that is printed as Python has it
AS_PYTHON = {"dict", "float", "frozenset", "list", "round", "set", "sorted", "tuple", "vars"}
DISPLAYS = (ast.Dict, ast.DictComp, ast.List, ast.ListComp, ast.Set, ast.SetComp, ast.Tuple)
#: after what a computer reads, such as a value in a file or a model: not in a command, whose words people read
MARK = "# for a file"


def _as_python(node: ast.expr, shown: set[str]) -> bool:
    if isinstance(node, ast.BoolOp):
        return any(_as_python(value, shown) for value in node.values)
    called = node.func if isinstance(node, ast.Call) else None
    return (
        isinstance(node, DISPLAYS)
        or (isinstance(called, ast.Name) and called.id in AS_PYTHON)
        or (isinstance(node, ast.Name) and node.id in shown)
    )


def _displays(scope: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Names that a function gives to lists and dictionaries alone."""
    given: dict[str, list[ast.expr]] = {}
    for node in ast.walk(scope):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    given.setdefault(target.id, []).append(node.value)
    return {name for name, values in given.items() if all(isinstance(value, DISPLAYS) for value in values)}


def _format(spec: ast.expr | None) -> str:
    """A format of an f-string, with 0 for what it takes from elsewhere."""
    parts = spec.values if isinstance(spec, ast.JoinedStr) else []
    return "".join(str(part.value) if isinstance(part, ast.Constant) else "0" for part in parts)


def formatted(tree: ast.Module) -> Iterator[ast.expr]:
    """Where a number, a list or a dictionary becomes text otherwise than by `openant_tools.numbers`."""
    everything = list(ast.walk(tree))
    scopes = [node for node in everything if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for nodes, shown in [(everything, set[str]()), *((ast.walk(scope), _displays(scope)) for scope in scopes)]:
        if nodes is not everything and not shown:
            continue  # nothing but what was seen with the whole module
        for node in nodes:
            if isinstance(node, ast.FormattedValue):
                found = not OF_NO_NUMBER.fullmatch(_format(node.format_spec)) or _as_python(node.value, shown)
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                found = node.func.id == "format" or (
                    node.func.id == "str" and bool(node.args) and _as_python(node.args[0], shown)
                )
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                found = (
                    node.func.attr == "format"
                    and isinstance(node.func.value, ast.Constant)
                    and ":" in node.func.value.value
                )
            else:
                found = (
                    isinstance(node, ast.BinOp)
                    and isinstance(node.op, ast.Mod)
                    and isinstance(node.left, ast.Constant)
                    and isinstance(node.left.value, str)
                )
            if found:
                yield node


@pytest.mark.parametrize(
    "code",
    [
        'f"{x:.3g} N·m"',
        'f"{x:,}"',
        'f"{x:+d}"',
        'f"{x:.{n}f}"',
        'f"{x:{n}.2}"',
        'f"{share:.0%}"',
        'f"{round(x, 2)} s"',
        'f"{float(x)!r} s"',
        'f"{[1.0, x]}"',
        'f"seen: {sorted(ids) or None}"',
        'def f():\n    values = {"id": x}\n    return f"reads {values}"',
        "str(round(x, 3))",
        'format(x, ".3f")',
        '"{:.1f} s".format(x)',
        '"%.1f s" % x',
    ],
)
def test_a_number_that_is_formatted_by_hand_is_seen(code):
    assert list(formatted(ast.parse(code)))


@pytest.mark.parametrize(
    "code",
    ['f"{number(x)}"', 'f"{name:>{width}} {words:40.40} {k:03d} {crc:08x} {day:%Y-%m-%d}"', 'f"{len(x)}"', "str(path)"],
)
def test_words_ids_and_dates_are_no_numbers(code):
    assert not list(formatted(ast.parse(code)))


def test_no_module_formats_a_number_that_people_read():
    """What a computer reads, such as a value in a file or a model, is marked as such; a command says all of its words to people."""
    found = []
    for module in modules():
        if module.name == "openant_tools/numbers.py":
            continue
        lines, spoken = module.text.splitlines(), module.name.startswith("openant_tools/cli/")
        found += [
            f"{module.name}:{node.lineno}"
            for node in formatted(module.tree)
            if spoken or not any(MARK in line for line in lines[node.lineno - 1 : node.end_lineno])
        ]
    assert not found, f"print with openant_tools.numbers: {found}"


def test_what_people_read_has_units_of_people_and_no_more_digits_than_a_measurement():
    """As it came out: `tests/builder.py` asks this of every finding that a step makes of a virtual robot, too."""
    assert unreadable("slow sweep; then 0.0412387612 N·m") == ["0.0412387612"]
    assert unreadable("up to 0.25 rad, 3.1 rad/s") == ["5 rad", "1 rad"]
    assert unreadable("reads {'id': 10}, seen: [1, 2], was None") == ["{'id':", "[1,", "None"]
    assert not unreadable("12.0° (11.5 to 12.6), 4.72 N·m/rad, firmware 4.5.100, 192.168.100.100, run 20260101.mcap")
    screens = sorted((TESTS / "tui" / "__snapshots__" / "test_looks").glob("*.txt"))
    assert screens
    found = {path.name: odd for path in screens if (odd := unreadable(path.read_text(encoding="utf-8")))}
    assert not found


def test_what_eight_servos_are_told_alike_is_one_line():
    joints = ["hip_rr", "knee_rr", "hip_fr"]
    writes = [EepromWrite(joint, 10 + k, "pwm_limit", 885, 442) for k, joint in enumerate(joints)]
    writes.append(EepromWrite("knee_fl", 31, "drive_mode", 1, 0))
    assert list(changes(writes)) == [
        "3 servos: at most 50 % of full power, as robot.toml says (pwm_limit 885 → 442)",
        "knee_fl (id 31): drive_mode 1 → 0",
    ]
