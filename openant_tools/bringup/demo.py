"""The whole way on a virtual robot, stage by stage: an interrupted demo goes on where it stopped, and one whose scenario was
edited does what follows from it."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from openant_tools.bringup.gait import FIRST_STEPS, first_look
from openant_tools.bringup.stages import Stage, StagedFolder, remove
from openant_tools.errors import BadInput
from openant_tools.files import write_text
from openant_tools.numbers import literal
from openant_tools.robot.config import CONFIG_NAME

__all__ = ["Demo"]

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


@dataclass(frozen=True)
class Demo(StagedFolder):
    """A robot's folder and how much is done in it.

    Attributes:
        folder: made where it is missing.
        steps: of training.
        record_s: length of each recording, s; shorter than the protocol's own, because a fit takes as long as its data.
        eval_s: robot time that the trained agent walks from each start to be measured, s.
        starts: how many.
        learns: whether torch is there to train with.
    """

    name: ClassVar[str] = "demo"
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
            literal(self.record_s),
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
                            *("eval", str(training), "--seconds", literal(self.eval_s), "--starts", str(self.starts)),
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
        state = self.state
        if (self.folder / CONFIG_NAME).exists() and not state.exists():
            raise BadInput(
                "holds a robot that is not the demo's, which would be mixed with a virtual one",
                where=self.folder,
                remedy="name a new folder with --robot",
            )
        if fresh and state.exists():
            made = {path for stage in self.stages() for path in (*stage.results, *stage.replaced, *stage.outdated)}
            kept_by_others = {
                self.folder / name for name in ("calibrated.xml", "journal.jsonl", "backups", self.state.name)
            }
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
                remove(path)
        self.folder.mkdir(parents=True, exist_ok=True)
        if not state.exists():
            write_text(state, "{}\n")
        if not self.scenario.exists():
            write_text(self.scenario, SCENARIO)
