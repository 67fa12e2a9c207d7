"""The whole way on a virtual robot: each stage is made of the commands that a user would type, and stands on their files.

A stage is done again only where it must be: its result is missing or older than what it is made from, or its commands
have changed. So an interrupted demo goes on where it stopped, and one whose scenario was edited does what follows from it.
"""

from __future__ import annotations

import importlib.util
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from openant_tools.errors import BadInput, OpenAntError
from openant_tools.files import json_text, read_json, write_text
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.workers import environment

__all__ = ["Demo", "Stage", "StageFailed", "openant"]

INTERRUPTED = 130
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
    """A command of a stage ended with another exit code than 0."""

    def __init__(self, stage: str, command: Sequence[str], code: int) -> None:
        super().__init__(
            f"the stage {stage!r} ended with exit code {code}, for the reason above",
            remedy=f"repeat `{words_of(command)}`; the demo goes on from there",
        )
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
        eval_s: robot time that the trained agent is measured for, s.
        learns: whether torch is there to train with.
    """

    folder: Path
    steps: int = 6000
    record_s: float = 16.0
    eval_s: float = 60.0
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
                "a robot's folder with the nominal values of its kit",
                (("config", "new", "--kit", "standard", "--robot", robot),),
                (),
                (self.nominal, self.folder / CONFIG_NAME),
            ),
            Stage(
                "record",
                "drive the virtual robot on its stand: a motion to fit, and another one twice, to judge by",
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
                "find what the data sheets do not know, and judge it on the motion that was held out",
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
                    "train an agent in the simulation that was just calibrated",
                    (
                        (
                            *("train", "sac", "--robot", robot, "--env", "sim", "--steps", str(self.steps)),
                            *("--learning-start", str(min(500, self.steps)), "--entropy-start", "0.1"),
                            *("--out", str(training), "--json", str(training / "train.json")),
                        ),
                    ),
                    (fit_json,),
                    (training / "learning_curve.csv", training / "train.json"),
                    outdated=(training,),
                ),
                Stage(
                    "measure",
                    "play what it learned and measure its reward",
                    (
                        (
                            *("eval", str(training), "--seconds", f"{self.eval_s:g}"),
                            *("--strip", str(self.pictures / "walk.png"), "--json", str(training / "eval.json")),
                        ),
                    ),
                    (training / "train.json",),
                    (training / "eval.json",),
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
            for path in {*made, *kept_by_others, self.fit, self.training, self.pictures, self.report, self.scenario}:
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

    def run(self, stage: Stage, show: Callable[[str], None]) -> None:
        """Do a stage.

        Args:
            show: called with each command before it runs.

        Raises:
            StageFailed: a command ended with another exit code than 0.
            KeyboardInterrupt: Ctrl-C; what was running has ended in its own orderly way before it is raised.
        """
        for path in stage.replaced:
            _remove(path)
        for path in stage.outdated:
            if path.exists() and _older((path,), stage.inputs):
                _remove(path)
        for command in stage.commands:
            show(words_of(command))
            code = openant(command)
            if code != 0:
                raise StageFailed(stage.name, command, code)
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


def openant(command: Sequence[str]) -> int:
    """Run `openant` with these arguments and return its exit code.

    The command runs in a process group of its own, so that a Ctrl-C reaches it once, by way of this process, which then
    waits until it has ended in its own way (torque off, checkpoint saved) and raises KeyboardInterrupt.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "openant_tools.cli", *command],
        stdin=subprocess.DEVNULL,
        process_group=0,
        env=environment(),
    )
    interrupted = False
    while True:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            interrupted = True
            process.send_signal(signal.SIGINT)
        else:
            break
    if interrupted or code in (INTERRUPTED, -signal.SIGINT):
        raise KeyboardInterrupt
    return code


def _older(results: Sequence[Path], inputs: Sequence[Path]) -> bool:
    """Whether any result is older than any input."""
    newest = max((path.stat().st_mtime_ns for path in inputs if path.exists()), default=0)
    return any(path.stat().st_mtime_ns < newest for path in results)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
