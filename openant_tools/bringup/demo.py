"""The whole way on a virtual robot: each stage is made of the commands that a user would type, and stands on their files.

A stage is done again only where it must be: its result is missing or older than what it is made from, or its commands
have changed. So an interrupted demo goes on where it stopped, and one whose scenario was edited does what follows from it.
"""

from __future__ import annotations

import contextlib
import importlib.util
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
from typing import IO

from openant_tools.bringup.gait import FIRST_STEPS, first_look
from openant_tools.errors import BadInput, OpenAntError
from openant_tools.files import json_text, read_json, write_text
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.workers import PROGRESS, environment

__all__ = ["Demo", "Stage", "StageFailed", "openant"]

INTERRUPTED = 130
#: of what a command said that failed
LAST_LINES = 15
#: s for its last words on how far it is
HEARD_S = 1.0
#: marks a folder as the demo's own, and remembers the commands that made what stands in it
STATE = "demo.json"

SCENARIO = """\
# What is wrong with the demo's virtual robot. `openant sysid fit` does not see this file: it has to find these values
# in the recordings, and report.html says how well it did. Change a value and run the demo again.

seed = 7

[robot]
kit = "standard"
setup = "stand"

[clock]
mode = "stepped"            # nobody waits for real time

[[effect]]                  # worn or badly set servos: all position loops 15 % softer than the data sheet says
effect = "stiffness_error"
joints = "all"
parameters = { scale = 0.85 }

[[effect]]                  # stiff gears: the nominal model says 0.05 N·m
effect = "coulomb_friction"
joints = ["hip_rr", "hip_fr", "hip_fl", "hip_rl"]
parameters = { torque_nm = 0.08 }

[[effect]]
effect = "coulomb_friction"
joints = ["knee_rr", "knee_fr", "knee_fl", "knee_rl"]
parameters = { torque_nm = 0.11 }

[[effect]]                  # heavier rotors in the hips than the nominal model's 0.0060 kg·m²
effect = "armature_error"
joints = ["hip_rr", "hip_fr", "hip_fl", "hip_rl"]
parameters = { kg_m2 = 0.009 }

[[effect]]                  # and two knees whose zeros are half a degree off
effect = "zero_offset"
joints = ["knee_fl"]
parameters = { angle_rad = 0.010 }

[[effect]]
effect = "zero_offset"
joints = ["knee_rr"]
parameters = { angle_rad = -0.008 }
"""


class StageFailed(OpenAntError):
    """A command of a stage ended with another exit code than 0.

    Attributes:
        said: the last lines that it said.
    """

    def __init__(self, stage: str, command: Sequence[str], code: int, said: str) -> None:
        super().__init__(
            f"the stage {stage!r} ended with exit code {code}, for the reason above",
            remedy=f"repeat `{words_of(command)}`; the demo goes on from there",
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
class Demo:
    """A robot's folder and how much is done in it.

    Attributes:
        folder: made where it is missing.
        steps: of training.
        record_s: length of each recording, s; shorter than the protocol's own, because a fit takes as long as its data.
        eval_s: robot time that the trained agent walks from each start to be measured, s.
        starts: how many.
        learns: whether torch is there to train with.
    """

    folder: Path
    steps: int = FIRST_STEPS
    record_s: float = 12.0
    eval_s: float = 20.0
    starts: int = 15
    learns: bool = importlib.util.find_spec("torch") is not None

    @property
    def scenario(self) -> Path:
        return self.folder / "scenario.toml"

    @property
    def nominal(self) -> Path:
        return self.folder / "nominal.xml"

    @property
    def fitted(self) -> Path:
        """The recording that the model is fitted to."""
        return self.folder / "recordings" / "stand.mcap"

    @property
    def held_out(self) -> tuple[Path, Path]:
        """Another motion, played twice: it judges the fit, and its repeat says what no model could beat."""
        return self.folder / "recordings" / "held-out.mcap", self.folder / "recordings" / "held-out-2.mcap"

    @property
    def fit(self) -> Path:
        return self.folder / "fit"

    @property
    def training(self) -> Path:
        return self.folder / "runs" / "demo"

    @property
    def pictures(self) -> Path:
        return self.folder / "pictures"

    @property
    def strip(self) -> Path:
        """Pictures of the walking robot; missing where there is no OpenGL, like the video."""
        return self.pictures / "walk.png"

    @property
    def video(self) -> Path:
        return self.pictures / "walk.webp"

    @property
    def log(self) -> Path:
        """What the commands said."""
        return self.folder / "demo.log"

    @property
    def report(self) -> Path:
        return self.folder / "report.html"

    def stages(self) -> tuple[Stage, ...]:
        """The stages in order, without the report that ends them."""
        robot, training = str(self.folder), self.training
        recordings = (self.fitted, *self.held_out)
        play = (
            "sysid",
            "record",
            "--virtual",
            str(self.scenario),
            "--protocol",
            "stand",
            "--seconds",
            f"{self.record_s:g}",
        )
        fit_json = self.fit / "fit.json"
        stages = [
            Stage(
                "robot",
                "a robot's folder with its kit's nominal values",
                (("config", "new", "--kit", "standard", "--robot", robot),),
                (),
                (self.nominal, self.folder / CONFIG_NAME),
            ),
            Stage(
                "record",
                "move the virtual robot on its stand, and record it",
                (
                    (*play, "--robot", robot, "--out", str(self.fitted), "--yes"),
                    (*play, "--seed", "1", "--repeat", "2", "--robot", robot, "--out", str(self.held_out[0]), "--yes"),
                ),
                (self.scenario,),
                recordings,
                replaced=recordings,
            ),
            Stage(
                "fit",
                "find what the data sheets do not know",
                (
                    (
                        *("sysid", "fit", str(self.fitted)),
                        *(word for path in self.held_out for word in ("--hold-out", str(path))),
                        *("--model", str(self.nominal), "--robot", robot, "--out", str(self.fit)),
                    ),
                ),
                recordings,
                (self.fit / "calibrated.xml", fit_json, self.fit / "report.html"),
            ),
        ]
        if self.learns:
            stages += [
                Stage(
                    "learn",
                    "train an agent in the calibrated simulation",
                    (
                        (
                            *("train", "sac", "--robot", robot, "--env", "sim", "--steps", str(self.steps)),
                            *first_look(self.steps),
                            *("--out", str(training), "--json", str(training / "train.json")),
                        ),
                    ),
                    (fit_json,),
                    (training / "learning_curve.csv", training / "train.json"),
                    outdated=(training,),
                ),
                Stage(
                    "measure",
                    f"let it walk from {self.starts} starts, and film it",
                    (
                        (
                            *("eval", str(training), "--seconds", f"{self.eval_s:g}", "--starts", str(self.starts)),
                            *("--strip", str(self.strip), "--video", str(self.video)),
                            *("--json", str(training / "eval.json")),
                        ),
                    ),
                    (training / "train.json",),
                    (training / "eval.json",),
                    replaced=(self.strip, self.video, self.video.with_suffix(".mp4")),
                ),
            ]
        return tuple(stages)

    def prepare(self, *, fresh: bool = False) -> None:
        """Make the folder ready: mark it as the demo's, write the scenario where there is none.

        Args:
            fresh: remove first whatever earlier demos made in it.

        Raises:
            BadInput: the folder holds a robot that is not the demo's.
        """
        state = self.folder / STATE
        if (self.folder / CONFIG_NAME).exists() and not state.exists():
            raise BadInput(
                "holds a robot that is not the demo's, which would be mixed with a virtual one",
                where=self.folder,
                remedy="name a new folder with --robot",
            )
        if fresh and state.exists():
            made = {path for stage in self.stages() for path in (*stage.results, *stage.replaced, *stage.outdated)}
            kept_by_others = {self.folder / name for name in ("calibrated.xml", "journal.jsonl", "backups", STATE)}
            for path in {
                *made,
                *kept_by_others,
                self.log,
                self.fit,
                self.training,
                self.pictures,
                self.report,
                self.scenario,
            }:
                _remove(path)
        self.folder.mkdir(parents=True, exist_ok=True)
        if not state.exists():
            write_text(state, "{}\n")
        if not self.scenario.exists():
            write_text(self.scenario, SCENARIO)

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
            _remove(path)
        for path in stage.outdated:
            if path.exists() and _older((path,), stage.inputs):
                _remove(path)
        for number, command in enumerate(stage.commands):

            def tell(share: float, words: str, number: int = number) -> None:
                progress((number + share) / len(stage.commands), words)

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
        write_text(self.folder / STATE, json_text({**self._done(), stage.name: stage.commands}))

    def _done(self) -> dict[str, list[list[str]]]:
        try:
            done = read_json(self.folder / STATE)
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
            share, _, words = line.rstrip("\n").partition(" ")
            with contextlib.suppress(ValueError):
                progress(float(share), words)


def _older(results: Sequence[Path], inputs: Sequence[Path]) -> bool:
    """Whether any result is older than any input."""
    newest = max((path.stat().st_mtime_ns for path in inputs if path.exists()), default=0)
    return any(path.stat().st_mtime_ns < newest for path in results)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
