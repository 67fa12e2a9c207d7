"""Robots that another program makes: it gets one drawn answer as JSON and an empty folder, and leaves run tables there.

The contract stands in docs/blind.md ("Makers"). The program is called once for each robot, without a shell, with both paths
behind its own arguments. Exit code 3 means that its physics cannot have what was drawn: that robot is left out of the set.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from openant_tools.blind.answers import OPEN
from openant_tools.blind.draw import Answer
from openant_tools.errors import BadInput
from openant_tools.files import read_json, reading
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run

__all__ = ["answer_for", "as_named_here", "is_made", "label_of", "make_by_command", "tables_of", "words_of"]

SCHEMA = "openant.blind-answer/1"
#: exit code of a program that cannot make such a robot
CANNOT = 3
#: key of a run's facts: joint of the answer → joint of the tables, where these have names of their own
STANDS_IN = "answer_joints"
#: folder in a robot's own in which the program writes; gone once all that it left has been taken over
_MAKING = ".making"


def words_of(command: str) -> list[str]:
    """A command line in words.

    Raises:
        BadInput: it does not parse, or there is no such program.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise BadInput(f"--maker does not read as a command: {error}", remedy="close its quotes") from None
    if not words or shutil.which(words[0]) is None:
        raise BadInput(
            f"--maker: there is no program {words[0] if words else ''!r}",
            remedy="say batch, bus, or a command that runs here, such as 'python my_generator'",
        )
    return words


def label_of(command: str) -> str:
    """What a command is called above its column: without its folders, and without the name of an interpreter."""
    try:
        words = shlex.split(command)
    except ValueError:
        words = command.split()
    words = [word.rstrip("/").rpartition("/")[2].replace("|", "/") for word in words]
    while len(words) > 1 and (words[0].startswith("python") or words[0] == "-m"):
        words.pop(0)
    return " ".join(words)


def answer_for(answer: Answer, robot: str, model: Path) -> dict[str, Any]:
    """What the program is told, as JSON."""
    table = answer.as_table()
    effects = table.pop("effect")
    for name in ("maker", "verdict"):
        table.pop(name)
    told: dict[str, Any] = {
        "schema": SCHEMA,
        "robot": robot,
        "model": str(model.resolve()),
        "outside": None,
        "parameters": {},
    }
    return {**told, **table, "effects": effects}


def is_made(robot: Path) -> bool:
    """Whether a robot's tables are all there."""
    return not (robot / _MAKING).exists() and bool(tables_of(robot))


def tables_of(robot: Path) -> list[Path]:
    """The run tables of a robot, in the order of their names."""
    return sorted(path for path in robot.glob("*") if path.suffix in (".parquet", ".csv"))


def make_by_command(command: str, answer: Answer, robot: Path, model: Path) -> bool:
    """Let a program make one robot's runs, and take over what it leaves; False where it cannot have what was drawn.

    Args:
        robot: the folder. What an earlier try left there goes first. model: the nominal MJCF of the set.

    Raises:
        BadInput: the program fails or leaves no runs: which robot it was, and the end of what it said.
    """
    where = f"{robot.name}, made by {label_of(command)}"
    for path in robot.glob("*"):
        if path.name != OPEN:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    making = robot / _MAKING
    making.mkdir(parents=True)
    # Outside the set: there an answer that is sealed would lie open.
    with tempfile.TemporaryDirectory(prefix="openant-answer-") as place:
        told = Path(place) / "answer.json"
        told.write_text(json.dumps(answer_for(answer, robot.name, model), indent=1) + "\n", encoding="utf-8")
        try:
            done = subprocess.run(
                [*words_of(command), str(told), str(making.resolve())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                check=False,
            )
        except OSError as error:
            raise BadInput(
                f"the maker does not start: {error.strerror}", where=where, remedy="run it by hand"
            ) from None
    if done.returncode == CANNOT:
        shutil.rmtree(robot)
        return False
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        ended = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
        raise BadInput(
            f"the maker failed ({ended}): {lines[-1] if lines else 'it said nothing on stderr'}",
            where=where,
            remedy="mend it and make the set again: robots that are done are kept",
        )
    _check(making, answer, where)
    for path in sorted(making.iterdir()):
        if path.name != OPEN:  # that is ours
            os.replace(path, robot / path.name)
    shutil.rmtree(making)
    return True


def _check(folder: Path, answer: Answer, where: str) -> None:
    """See that there are runs which can be read, and that the answer's joints are among theirs."""
    found = tables_of(folder)
    if not found:
        raise BadInput("the maker left no run tables", where=where, remedy="let it write NAME.parquet or NAME.csv")
    for path in found:
        try:
            run = read_run(path)
        except BadInput as error:
            raise BadInput(
                f"the maker's {path.name} cannot be used: {error.what}", where=where, remedy=error.remedy
            ) from None
        if run.model_path is not None and not run.model_path.is_file():
            raise BadInput(
                f"the maker's {path.name} names a model that is not there: {run.facts.model}",
                where=where,
                remedy="write the MJCF beside the tables",
            )
        _joints_here(answer, run, where)


def _joints_here(answer: Answer, run: Run, where: str) -> None:
    renamed = _renaming(run.facts.extra, where)
    for drawn in answer.effects:
        if isinstance(drawn.joints, str):
            continue
        if not {renamed.get(name, name) for name in drawn.joints} <= set(run.joints):
            # Which of them it is would tell the answer.
            raise BadInput(
                f"the maker's {run.name} does not have the joints that answers name",
                where=where,
                remedy=f'let its facts say which is which: "{STANDS_IN}": {{"hip_rr": NAME, …}} for all eight',
            )


def _renaming(extra: Mapping[str, Any], where: str | Path) -> Mapping[str, str]:
    """Joint of the answer → joint of a run, as its facts say; empty where they are the same.

    Raises:
        BadInput: that is no table of names.
    """
    table = extra.get(STANDS_IN, {})
    if not isinstance(table, dict) or not all(isinstance(name, str) for name in table.values()):
        raise BadInput(f"`{STANDS_IN}` is not a table of names", where=where, remedy='write {"hip_rr": NAME, …}')
    return table


def as_named_here(answer: Answer, robot: Path) -> Answer:
    """The answer with its joints as the robot's tables name them."""
    facts = next(iter(sorted(path.with_suffix(".json") for path in tables_of(robot))), None)
    if facts is None or not facts.is_file():
        return answer
    with reading(facts, "the facts are not as they were written", "make the set anew"):
        renamed = _renaming(read_json(facts), facts)
    if not renamed:
        return answer
    return replace(
        answer,
        effects=tuple(
            drawn
            if isinstance(drawn.joints, str)
            else replace(drawn, joints=tuple(dict.fromkeys(renamed.get(name, name) for name in drawn.joints)))
            for drawn in answer.effects
        ),
    )
