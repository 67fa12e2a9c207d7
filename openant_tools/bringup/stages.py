"""A way that is made of commands which a user could type: each stage stands on files, and is not done again while it does.

A stage is done again only where it must be: its result is missing or older than what it is made from, or its commands have
changed. So whatever was interrupted or killed goes on where it stopped.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, ClassVar

from openant_tools.errors import BadInput, OpenAntError
from openant_tools.files import json_text, read_json, write_text
from openant_tools.procedure.relay import part_of
from openant_tools.workers import PROGRESS, environment, passed_on

__all__ = ["Stage", "StageFailed", "StagedFolder", "openant", "remove", "words_of"]

INTERRUPTED = 130
#: of what a command said that failed
LAST_LINES = 15
#: s for its last words on how far it is
HEARD_S = 1.0


class StageFailed(OpenAntError):
    """A command of a stage ended with another exit code than 0.

    Attributes:
        said: the last lines that it said.
    """

    def __init__(self, stage: str, command: Sequence[str], code: int, said: str) -> None:
        super().__init__(
            f"the stage {stage!r} ended with exit code {code}, for the reason above",
            remedy=f"repeat `{words_of(command)}`, or the whole, which goes on from there",
        )
        self.said = said
        self.exit_code = code if code in (1, 2, INTERRUPTED) else 2


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        name: one word.
        words: what it does.
        commands: arguments of `openant`, one tuple a command.
        inputs, results: files that it is made from, and that it makes; the last command writes the last result.
        replaced: what must go before it is done again, because its commands never write over it.
        outdated: what must go if it is older than the inputs; younger, the commands go on from it.
    """

    name: str
    words: str
    commands: tuple[tuple[str, ...], ...]
    inputs: tuple[Path, ...]
    results: tuple[Path, ...]
    replaced: tuple[Path, ...] = ()
    outdated: tuple[Path, ...] = ()

    @property
    def command_lines(self) -> tuple[str, ...]:
        """The commands as they are typed."""
        return tuple(words_of(command) for command in self.commands)


@dataclass(frozen=True)
class StagedFolder:
    """A folder that stages are done in.

    Attributes:
        folder: made where it is missing.
        name: of the whole; what the folder remembers of it stands in NAME.json, and what its commands said in NAME.log.
    """

    folder: Path
    name: ClassVar[str]

    @property
    def state(self) -> Path:
        """The commands that made what stands in the folder, stage by stage."""
        return self.folder / f"{self.name}.json"

    @property
    def log(self) -> Path:
        """What the commands said."""
        return self.folder / f"{self.name}.log"

    def stands(self, stage: Stage) -> bool:
        """Whether a stage's results are there, made by the same commands, and not older than what they are made from."""
        if self._done().get(stage.name) != [list(command) for command in stage.commands]:
            return False
        return all(path.exists() for path in stage.results) and not _older(stage.results, stage.inputs)

    def run(self, stage: Stage, progress: Callable[[float, str], None] = lambda share, words: None) -> None:
        """Do a stage; its commands and what they say go to the log.

        Args:
            progress: called in a thread of its own, with what is being done and the share of the stage that is done.

        Raises:
            StageFailed: a command ended with another exit code than 0.
            KeyboardInterrupt: Ctrl-C; what was running has ended in its own orderly way before it is raised.
        """
        for path in stage.replaced:
            remove(path)
        for path in stage.outdated:
            if path.exists() and _older((path,), stage.inputs):
                remove(path)
        for number, command in enumerate(stage.commands):
            tell = part_of(progress, number, len(stage.commands))
            self.folder.mkdir(parents=True, exist_ok=True)
            with self.log.open("a", encoding="utf-8") as log:
                log.write(f"$ {words_of(command)}\n")
                log.flush()
                since = log.tell()
                code = openant(command, log, tell)
            if code != 0:
                with self.log.open(encoding="utf-8", errors="replace") as lines:
                    lines.seek(since)
                    said = "".join(lines.readlines()[-LAST_LINES:]).rstrip()
                raise StageFailed(stage.name, command, code, said)
        write_text(self.state, json_text({**self._done(), stage.name: stage.commands}))

    def _done(self) -> dict[str, list[list[str]]]:
        try:
            done = read_json(self.state)
        except (OSError, BadInput):
            # Whatever is unreadable here only costs doing a stage again.
            return {}
        return done if isinstance(done, dict) else {}


def words_of(command: Sequence[str]) -> str:
    """A command as it is typed."""
    return shlex.join(["openant", *command])


def openant(
    command: Sequence[str], log: IO[str] | None = None, progress: Callable[[float, str], None] | None = None
) -> int:
    """Run `openant` with these arguments and return its exit code.

    The command runs in a process group of its own, so that a Ctrl-C reaches it once, by way of this process, which then
    waits until it has ended in its own way (torque off, checkpoint saved) and raises KeyboardInterrupt.

    Args:
        log: where everything goes that it says; None: where this process' own words go.
        progress: called in a thread of its own, with what the command is doing and how far it is, from 0 to 1.
    """
    told, tells = os.pipe()
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "openant_tools.cli", *command],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=None if log is None else subprocess.STDOUT,
            process_group=0,
            pass_fds=(tells,),
            env={**environment(), PROGRESS: str(tells)},
        )
    except BaseException:
        os.close(told)
        raise
    finally:
        os.close(tells)
    hears = threading.Thread(target=_hear, args=(told, progress or (lambda share, words: None)), daemon=True)
    hears.start()
    interrupted = False
    while True:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            interrupted = True
            process.send_signal(signal.SIGINT)
        else:
            break
    hears.join(HEARD_S)
    if interrupted or code in (INTERRUPTED, -signal.SIGINT):
        raise KeyboardInterrupt
    return code


def _hear(told: int, progress: Callable[[float, str], None]) -> None:
    """What `workers.pass_on` says in the command, until it has ended."""
    with open(told, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            told_now = passed_on(line)
            if told_now is not None:
                progress(*told_now)


def _older(results: Sequence[Path], inputs: Sequence[Path]) -> bool:
    """Whether any result is older than any input."""
    newest = max((path.stat().st_mtime_ns for path in inputs if path.exists()), default=0)
    return any(path.stat().st_mtime_ns < newest for path in results)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
