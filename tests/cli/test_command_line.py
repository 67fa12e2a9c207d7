"""The command line as a user meets it: manuals that open at once, refusals in one line, Ctrl-C that leaves things in order."""

from __future__ import annotations

import ast
import inspect
import io
import json
import math
import os
import re
import resource
import select
import signal
import stat
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import click
import mujoco
import numpy as np
import pytest
from plants import drive, pendulum, run_of, sweep
from rich.console import Console

from openant_tools.cli import face, main
from openant_tools.cli import openant as manual
from openant_tools.cli.face import CommandFace
from openant_tools.cli.streams import has_terminal
from openant_tools.errors import BadInput
from openant_tools.procedure.step import Ask, Live, Progress
from openant_tools.recording.tables import write_table

OPENANT = (sys.executable, "-m", "openant_tools.cli")
#: s; only a command that hangs takes longer
PATIENCE_S = 120.0

Result = subprocess.CompletedProcess[str]


def openant(*arguments: str | Path, cwd: Path | None = None, largest_file: int | None = None) -> Result:
    """Run a command to its end; `largest_file` (bytes) makes the disk as good as full."""

    def limit() -> None:
        assert largest_file is not None
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    # On such a disk Python leaves a part of a compiled module, which nothing that comes later can load.
    cached = {} if largest_file is None else {"PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [*OPENANT, *map(str, arguments)], cwd=cwd, text=True, capture_output=True, timeout=PATIENCE_S,
        preexec_fn=None if largest_file is None else limit, stdin=subprocess.DEVNULL, env=os.environ | cached,
    )  # fmt: skip


@pytest.fixture
def within(capfd: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """Run a command to its end in this process: what it says and how it ends are the same, and nothing is loaded anew."""

    def run(*arguments: str | Path) -> Result:
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            main([str(one) for one in arguments])
        assert isinstance(end.value.code, int)
        return Result(arguments, end.value.code, *capfd.readouterr())

    return run


def refusal(result: Result) -> str:
    """The one line of a refusal: exit code 2, no result, no traceback; what it was about to do may stand before it."""
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    *progress, line = [line for line in result.stderr.splitlines() if line.strip()]
    assert line.startswith("openant")
    assert not any(before.startswith("openant") for before in progress), result.stderr
    assert "→" in line, f"no remedy: {line}"
    return line


# ---- manuals ----

WALK = """
import importlib, json, sys
import click
from openant_tools.cli import COMMANDS, main, openant

def paths(command, path):
    yield path
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            yield from paths(command.get_command(context, name), [*path, name])

manuals = {}
for path in paths(openant, []):
    from io import StringIO
    sys.stdout = StringIO()
    try:
        main([*path, "--help"])
    except SystemExit as end:
        assert end.code == 0, (path, end.code)
    manuals[" ".join(path)] = sys.stdout.getvalue()
sys.stdout = sys.__stdout__
heavy = ["torch", "mujoco", "scipy", "matplotlib", "cv2", "pyarrow", "numpy", "gymnasium", "textual"]
print(json.dumps({"manuals": manuals, "imported": [name for name in heavy if name in sys.modules]}))
"""


@pytest.fixture(scope="module")
def manuals() -> dict[str, str]:
    result = subprocess.run([sys.executable, "-c", WALK], text=True, capture_output=True, timeout=PATIENCE_S)
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["imported"] == [], "a manual that imports these opens slowly"
    pages: dict[str, str] = answer["manuals"]
    return pages


def test_every_command_has_a_manual_and_none_of_them_imports_what_is_heavy(manuals: dict[str, str]) -> None:
    for command in ("", "demo", "virtual start", "config check", "comms scan", "rec repair", "sysid record", "sysid fit",
                    "train sac", "eval"):  # fmt: skip
        assert command in manuals
    for command, page in manuals.items():
        assert page.startswith(f"Usage: openant {command}".rstrip()), page
        # A sentence at least, before the options.
        assert re.search(r"\n  [A-Z].{20,}", page), f"{command} does not say what it does"


def test_the_first_page_lists_every_command_with_its_line(manuals: dict[str, str]) -> None:
    commands = {path.split()[0] for path in manuals if path}
    for command in commands:
        assert re.search(rf"^  {command} +\S", manuals[""], re.MULTILINE), command
    assert "openant demo" in manuals[""]


def test_an_unknown_command_is_refused_and_a_near_one_suggested() -> None:
    assert "'nosuch'" in refusal(openant("nosuch"))
    assert "'fit'" in refusal(openant("sysid", "fitt"))
    assert "--rate" in refusal(openant("sysid", "record", "--rat", "3"))


def commands(command: click.Command, path: str = "openant") -> Iterator[tuple[str, click.Command]]:
    """Every command with what is typed for it."""
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from commands(found, f"{path} {name}")


def ends(function: ast.FunctionDef) -> Iterator[int]:
    """The lines on which a function may end in order: not by a fault, nor where another function within it ends."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda):
            continue
        called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Return) or called == "SystemExit" or called.endswith(".exit"):
            assert isinstance(node, ast.stmt | ast.expr)
            yield node.lineno
        waiting.extend(ast.iter_child_nodes(node))


def test_no_command_that_is_asked_for_a_report_ends_before_it_has_written_one() -> None:
    """Those that can be run in a moment are run with it elsewhere; what could end early is found in all of them."""
    asked = {
        path: command.callback
        for path, command in commands(manual)
        if any("--report" in option.opts for option in command.params)
    }
    assert {"openant thermal compare", "openant gap measure", "openant sysid fit", "openant policies rank"} <= set(
        asked
    )
    for path, callback in asked.items():
        assert callback is not None
        [function] = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(callback)))).body
        assert isinstance(function, ast.FunctionDef)
        written = [
            node.lineno for node in ast.walk(function)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "write_report"
        ]  # fmt: skip
        assert written, f"{path} --report: it writes none"
        early = [line for line in ends(function) if line < max(written)]
        assert not early, f"{path} --report: it may end in line {early[0]} of its function without one"


def test_the_version_is_printed() -> None:
    result = openant("--version")
    assert result.returncode == 0
    assert re.match(r"openant, version \d", result.stdout)


# ---- bad input ----


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user has it: a log of a motor on a bench, its model, and each of them spoilt in one way."""
    folder = tmp_path_factory.mktemp("bench")
    # Nothing stands below the arm in these runs, as formats, section 1, has it for a stand.
    model = pendulum().replace('name="bench"', 'name="bench" contype="0" conaffinity="0"')
    (folder / "arm.xml").write_text(model)
    robot = mujoco.MjModel.from_xml_string(model.replace('damping="0.12"', 'damping="0.16"'))
    t = np.arange(0.0, 6.0, 0.01)
    run = run_of(drive(robot, ["joint"], t, sweep(t, 1)), t, ["joint"], "swing", setup="stand")
    write_table(run, folder / "swing.csv")
    write_table(run, folder / "whole.parquet")

    header, *rows = (folder / "swing.csv").read_text().replace('"', "").splitlines()
    position = header.split(",").index("pos.joint")

    def spoil(name: str, lines: list[str]) -> None:
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
        (folder / f"{name}.json").write_text('{"joints": ["joint"]}')

    def with_cell(row: int, column: int, text: str) -> list[str]:
        cells = rows[row].split(",")
        cells[column] = text
        return [header, *rows[:row], ",".join(cells), *rows[row + 1 :]]

    spoil("column", [header.replace("pos.joint", "pos.jiont"), *rows])
    spoil("unit", with_cell(29, position, "300"))
    spoil("time", with_cell(29, 0, "0.01"))
    spoil("empty", [header])
    spoil("facts", [header, *rows])
    (folder / "facts.json").write_text('{"joints": ["jo')
    (folder / "cut.parquet").write_bytes((folder / "whole.parquet").read_bytes()[:2000])
    (folder / "cut.mcap").write_bytes(b"\x89MCAP0\r\n\x01")
    (folder / "broken.xml").write_text(model.replace("</body>", ""))
    (folder / "unknown.xml").write_text(model.replace("frictionloss", "fricton"))
    (folder / "bare.xml").write_text(re.sub(r"<actuator>.*</actuator>", "", model, flags=re.DOTALL))
    (folder / "motor.xml").write_text(re.sub(r"<position [^>]*>", '<motor joint="joint"/>', model))
    (folder / "other.xml").write_text(model.replace('"joint"', '"elbow"'))
    return folder


@pytest.mark.parametrize(
    ("run", "more", "said"),
    [
        ("column.csv", (), ("column.csv, column pos.jiont", "no such joint", "did you mean joint")),
        ("unit.csv", (), ("unit.csv, column pos.joint, row 30", "300 rad cannot be", "angles are in rad")),
        ("time.csv", (), ("time.csv, column t, row 30", "time runs backwards", "sort the rows")),
        ("empty.csv", (), ("empty.csv", "the run is empty", "record again")),
        ("facts.csv", (), ("facts.json",)),
        ("cut.parquet", (), ("cut.parquet", "not a whole parquet file", "export it again")),
        ("cut.mcap", (), ("cut.mcap",)),
        ("missing.csv", (), ("missing.csv", "no such file")),
        ("swing.csv", ("--joint", "elbow"), ("arm.xml", "no position-controlled joint 'elbow'", "joint")),
        ("swing.csv", ("--kind", "mass"), ("no such parameter: mass", "stiffness")),
        ("swing.csv", ("--hold-out", "swing.csv"), ("held-out run is also fitted",)),
        ("swing.csv", ("--model", "broken.xml"), ("broken.xml", "MuJoCo cannot load it")),
        ("swing.csv", ("--model", "unknown.xml"), ("unknown.xml", "MuJoCo cannot load it", "fricton")),
        ("swing.csv", ("--model", "bare.xml"), ("bare.xml", "no actuators", "<position>")),
        ("swing.csv", ("--model", "motor.xml"), ("motor.xml", "position servo", "<position>")),
        ("swing.csv", ("--model", "other.xml"), ("other.xml", "elbow", "named as in the runs")),
        ("swing.csv", ("--model", "missing.xml"), ("missing.xml", "no such model")),
    ],
)
def test_a_fit_refuses_bad_input_in_one_line_and_leaves_nothing(
    bench: Path,
    within: Callable[..., Result],
    monkeypatch: pytest.MonkeyPatch,
    run: str,
    more: tuple[str, ...],
    said: tuple[str, ...],
) -> None:
    monkeypatch.chdir(bench)
    before = set(bench.rglob("*"))
    model = () if "--model" in more else ("--model", "arm.xml")
    line = refusal(within("sysid", "fit", run, *model, *more, "--out", "fit"))
    for words in said:
        assert words in line
    assert set(bench.rglob("*")) == before


def test_a_fit_without_model_and_robot_asks_for_one(bench: Path) -> None:
    assert "--model" in refusal(openant("sysid", "fit", "swing.csv", "--out", "fit", cwd=bench))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("rec", "info", "nowhere"), "no such file"),
        (("rec", "export", "empty.csv", "--to", "parquet", "--out", "x"), "the run is empty"),
        (("config", "show", "--robot", "nowhere"), "nowhere"),
        (("config", "import", "arm.xml", "--robot", "x"), "arm.xml"),
        (("comms", "scan", "--port", "/dev/ttyNOPE"), "/dev/ttyNOPE"),
        (("sysid", "record", "--virtual", "nowhere.toml", "--out", "x.mcap", "--yes"), "nowhere.toml"),
        (("sysid", "record", "--virtual", "nowhere.json", "--out", "x.mcap", "--yes"), "nowhere.json"),
        (("sysid", "record", "--protocol", "dance", "--virtual", "--out", "x.mcap", "--yes"), "dance"),
        (("virtual", "start", "--scenario", "broken.xml"), "broken.xml"),
        (("train", "sac", "--robot", "nowhere", "--out", "x"), "nowhere"),
        (("train", "sac", "--kit", "standard", "--unattended", "--out", "x"), "--unattended is for a robot"),
        (("eval", "nowhere"), "nowhere"),
        (("demo", "--robot", "arm.xml"), "arm.xml"),
    ],
)
def test_other_commands_refuse_in_one_line_too(
    bench: Path, within: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(bench)
    before = set(bench.rglob("*"))
    assert said in refusal(within(*arguments))
    assert set(bench.rglob("*")) == before


@pytest.mark.parametrize("command", [("sysid", "record"), ("thermal", "soak"), ("comms", "soak")])
def test_a_link_to_nothing_is_no_name_for_a_recording_and_said_before_it_connects(
    tmp_path: Path, within: Callable[..., Result], command: tuple[str, ...]
) -> None:
    (tmp_path / "run.mcap").symlink_to(tmp_path / "gone.mcap")
    result = within(*command, "--virtual", "nowhere.json", "--out", str(tmp_path / "run.mcap"), "--yes")
    assert "run.mcap: this is a link to nothing" in refusal(result)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_unattended_training_tells_what_goes_on_alone_before_anybody_gives_the_word(
    within: Callable[..., Result], tmp_path: Path
) -> None:
    pytest.importorskip("torch")
    result = within("train", "sac", "--env", "hardware", "--virtual", "--unattended", "--out", str(tmp_path / "run"))
    assert result.returncode == 2
    table, asked = result.stderr.split("openant: ")
    assert "the camera does not see the robot: 20× in 10 min" in table
    assert "All else ends the run, torque off and saved:" in table
    assert "nobody is there to ask" in asked
    assert not (tmp_path / "run").exists()


# ---- a full disk ----


@pytest.mark.parametrize("largest", [100, 4000])
def test_on_a_full_disk_a_fit_leaves_no_part_of_itself(bench: Path, tmp_path: Path, largest: int) -> None:
    """At first nothing fits, then the small files do and the report does not."""
    out = tmp_path / "fit"
    result = openant("sysid", "fit", bench / "swing.csv", "--model", bench / "arm.xml", "--kind", "damping",
                     "--out", out, largest_file=largest)  # fmt: skip
    line = refusal(result)
    assert str(out) in line
    assert "make room" in line
    assert list(tmp_path.iterdir()) == []


def test_on_a_full_disk_an_export_and_a_new_robot_leave_nothing(bench: Path, tmp_path: Path) -> None:
    line = refusal(openant("rec", "export", bench / "swing.csv", "--to", "parquet", "--out", tmp_path / "tables",
                           largest_file=500))  # fmt: skip
    assert "swing.parquet" in line
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []

    line = refusal(openant("config", "new", "--robot", tmp_path / "ant", largest_file=500))
    assert "make room" in line
    assert not (tmp_path / "ant" / "robot.toml").exists()


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="there is no /dev/full here")
def test_a_device_is_written_to_and_stays_a_device(bench: Path) -> None:
    line = refusal_after_output(openant("rec", "info", bench / "swing.csv", "--json", "/dev/full"))
    assert "/dev/full" in line
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)
    result = openant("rec", "info", bench / "swing.csv", "--json", "/dev/stdout")
    assert '"rows"' in result.stdout


def refusal_after_output(result: Result) -> str:
    return refusal(subprocess.CompletedProcess(result.args, result.returncode, "", result.stderr))


# ---- Ctrl-C ----


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts commands, and ends what is still running after the test."""
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: str | Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*OPENANT, *map(str, arguments)], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            # rich shows its progress where it is told that someone looks.
            env={**os.environ, "TTY_COMPATIBLE": "1", "TTY_INTERACTIVE": "1"},
        )  # fmt: skip
        running.append(process)
        return process

    yield start
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < give_up, "it never came"
        time.sleep(0.05)


def test_ctrl_c_in_a_fit_leaves_nothing_behind(
    bench: Path, tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    out = tmp_path / "fit"
    process = started("sysid", "fit", bench / "swing.csv", "--model", bench / "arm.xml", "--out", out)
    stderr = process.stderr
    assert stderr is not None
    wait_until(lambda: bool(select.select([stderr], [], [], 0)[0]), process)  # the first sign of its progress
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in said
    if process.returncode == 0:
        # It had just ended: then all of it is there.
        assert sorted(path.name for path in out.iterdir()) == ["calibrated.xml", "fit.json", "report.html"]
    else:
        assert process.returncode == 130
        assert list(tmp_path.iterdir()) == []


def test_ctrl_c_in_training_saves_and_the_same_command_goes_on(
    tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    pytest.importorskip("torch")
    out = tmp_path / "run"
    command = ("train", "sac", "--kit", "standard", "--learning-start", "100", "--out", out, "--steps")
    process = started(*command, "1000000")
    curve = out / "learning_curve.csv"
    wait_until(lambda: curve.exists() and len(curve.read_text().splitlines()) > 1, process)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "the same command goes on" in said
    assert "Traceback" not in said
    assert sorted(path.name for path in out.iterdir() if not path.name.startswith(".")) == [
        "checkpoint.pt", "learning_curve.csv", "run.json", "transitions.f32",
    ]  # fmt: skip
    done = int(curve.read_text().splitlines()[-1].split(",")[0])
    result = openant(*command, str(done + 100))
    assert result.returncode == 0, result.stderr
    assert int(curve.read_text().splitlines()[-1].split(",")[0]) == done + 100


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_being_told_to_go_is_as_good_as_ctrl_c(
    bench: Path, tmp_path: Path, started: Callable[..., subprocess.Popen[str]], number: signal.Signals
) -> None:
    process = started("virtual", "start", "--no-camera", "--ready-file", tmp_path / "ant.json")
    wait_until((tmp_path / "ant.json").exists, process)
    process.send_signal(number)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


# ---- numbers ----


def paths(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Every command of the program with the words that call it, so that a new one is included by itself."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            one = command.get_command(context, name)
            assert one is not None
            yield from paths(one, (*path, name))
    else:
        yield path, command


NUMBERS = [
    (words, option.opts[0])
    for words, command in paths(manual)
    for option in command.params
    if isinstance(option.type, click.FloatRange | click.types.FloatParamType)
]


@pytest.mark.parametrize(("words", "option"), NUMBERS, ids=lambda one: " ".join(one) if isinstance(one, tuple) else one)
def test_what_is_no_number_is_refused_by_name_on_every_command(
    words: tuple[str, ...], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    times = option in ("--seconds", "--minutes", "--rate", "--hz", "--dt")
    for value in ("nan", "inf", "-inf", "1e300", "-1e300", "x", *(("0", "-1") if times else ())):
        with pytest.raises(SystemExit) as end:
            main([*words, f"{option}={value}"])
        said = capsys.readouterr()
        assert end.value.code == 2, (value, said)
        [line] = said.err.strip().splitlines()
        # Where the value may be left out, click takes what begins with a minus for options.
        assert option in line or "No such option" in line, line
        assert "→" in line
        assert said.out == ""


def test_a_process_that_was_killed_is_said_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killed(**_: object) -> None:
        raise BrokenProcessPool("exit codes of the workers are {SIGKILL(-9)}")

    monkeypatch.setattr("openant_tools.cli.openant.main", killed)
    with pytest.raises(SystemExit) as ended:
        main(["gap"])
    assert ended.value.code == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("openant: a process that did a part of this was killed; memory may be short → ")


def test_a_question_for_a_number_says_its_unit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In brackets, which are no markup of the terminal's colours."""
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    given = iter(["700", "3"])
    monkeypatch.setattr("builtins.input", lambda: next(given))
    asked = Ask("Soak for how long?", unit="min", default=10.0, low=0, high=600)
    assert CommandFace(yes=False).answer(asked) == 3.0
    said = capsys.readouterr()
    assert "Soak for how long? [min] (10.0): " in said.out + said.err
    assert "from 0 to 600 min" in said.out + said.err


def test_enter_ends_what_is_watched_while_progress_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was typed before it was shown counts for nothing; what is typed between two pictures of it does."""
    typed = [True]
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr(face, "_entered", lambda: bool(typed) and typed.pop())
    shown = CommandFace(yes=False)
    watched = Live({"hip_rr": 31.0}, "°C", "cooling")
    assert shown.answer(watched) is False
    shown.answer(Progress(0.5, "cooling"))
    typed.append(True)
    assert shown.answer(watched) is True
    shown.answer(Progress(0.6, "cooling"))
    assert shown.answer(watched) is False


def test_a_servo_that_falls_silent_while_it_is_shown_is_said_to(capsys: pytest.CaptureFixture[str]) -> None:
    shown = CommandFace(yes=True)
    shown.console = Console(stderr=True, force_terminal=True)
    ends = {"hip_rr": -1.0, "knee_rr": -1.0}, {"hip_rr": 1.0, "knee_rr": 1.0}
    shown.answer(Live({"hip_rr": 0.5, "knee_rr": math.nan}, "rad", "turning", *ends))
    said = capsys.readouterr().err.splitlines()
    assert "+28.6°" in said[0]
    assert said[1].endswith("knee_rr  does not answer")


# ---- no terminal, and no stream at all ----


def without_stdin(*arguments: str | Path, cwd: Path) -> Result:
    """As `openant … <&-`, a cron job or a service does it."""
    return subprocess.run(
        [*OPENANT, *map(str, arguments)], cwd=cwd, text=True, capture_output=True, timeout=PATIENCE_S,
        preexec_fn=lambda: os.close(0), check=False,
    )  # fmt: skip


def test_a_command_whose_input_is_closed_works_where_it_may_move_and_is_refused_in_one_line_where_not(
    tmp_path: Path,
) -> None:
    scenario = tmp_path / "blind.toml"
    scenario.write_text('[camera]\npresent = false\n[clock]\nmode = "stepped"\n')
    record = ("sysid", "record", "--virtual", scenario, "--protocol", "stand", "--seconds", "5", "--out", "run.mcap")
    assert "and nobody is there to ask → " in refusal(without_stdin(*record, cwd=tmp_path))
    done = without_stdin(*record, "--yes", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("run")
    manual_of_all = without_stdin(cwd=tmp_path)
    assert manual_of_all.returncode == 2
    assert "Traceback" not in manual_of_all.stderr


def test_a_command_ends_as_it_should_where_all_streams_are_closed(tmp_path: Path) -> None:
    def close() -> None:
        os.closerange(0, 3)

    for arguments, status in ((("comms", "ports"), 0), (("config", "show", "--robot", "nowhere"), 2)):
        ended = subprocess.run([*OPENANT, *arguments], cwd=tmp_path, timeout=PATIENCE_S, preexec_fn=close, check=False)
        assert ended.returncode == status, arguments


def test_a_stream_that_is_not_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.StringIO())
        getattr(sys, name).close()
        assert not has_terminal(name)
        monkeypatch.setattr(sys, name, None)
        assert not has_terminal(name)
    assert CommandFace(yes=True).answer(Ask("Which?", default="this one", unit="text")) == "this one"
    with pytest.raises(BadInput, match="nobody is there to ask"):
        CommandFace(yes=False).answer(Ask("Which?", unit="text"))


def test_an_answer_may_be_the_beginning_of_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(face, "need_terminal", lambda why: None)
    given = iter(["n", "Y", "", "no other"])
    monkeypatch.setattr("builtins.input", lambda: next(given))
    shown = CommandFace(yes=False)
    asked = Ask("Did it turn?", ("yes", "no", "no other"), default="yes")
    assert [shown.answer(asked) for _ in range(3)] == ["yes", "yes", "no other"], "n is one of two, and asked again"
    said = capsys.readouterr()
    assert "[yes/no/no other]" in said.out + said.err
    assert "one of: yes, no, no other" in said.out + said.err
