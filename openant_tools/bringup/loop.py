"""From simulation to robot and back: an agent is trained in a robot's simulation and played on the robot, the simulation improved
by what that recording says, the agent trained on in it, and played again; beside a control that is trained on as long in the
simulation as it was.

Each stage is a command of `openant`, and its result is kept as it ends. Where the diagnosis names nothing to improve, the control
is all that there is to train on: then it stands for both, and the result says so.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from openant_tools.bringup.stages import Stage, StagedFolder
from openant_tools.errors import BadInput
from openant_tools.files import json_text, known, read_json, write_text
from openant_tools.gap.diagnosis import Diagnosis, read_diagnosis
from openant_tools.numbers import literal
from openant_tools.procedure.intervals import Interval
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.robot.folder import RobotFolder
from openant_tools.virtual.process import VIRTUAL_DEFAULT, placeable
from openant_tools.virtual.scenario import load_scenario, read_scenario_file
from openant_tools.virtual.seal import KEY_VARIABLE, is_sealed, read_key

__all__ = ["Loop", "Played", "Result", "result_of"]

SCHEMA = "openant.loop/1"
#: what was asked for, in the loop's folder
ASKED = "asked.json"
#: there: the hash of the robot's model and effects
SIMULATION = "simulation"
#: of the robot's engine, for whose settings alone it is looked up here
RATE_HZ = 100.0


@dataclass(frozen=True)
class Loop(StagedFolder):
    """What is asked for, and the folder that keeps how far it is.

    Attributes:
        robot: the robot's folder; nothing in it changes.
        virtual: as `--virtual` gives it; None for the robot itself.
        steps, fine_tune_steps: of training, and of training on.
        seed: of all that is drawn.
        seconds, starts: robot time from each start, s, and how many, of every play.
        settings: of the agent, as `openant tune` wrote them.
    """

    name: ClassVar[str] = "loop"
    robot: Path
    virtual: str | None
    steps: int
    fine_tune_steps: int
    seed: int
    seconds: float = 12.0
    starts: int = 5
    settings: Path | None = None

    @property
    def trained(self) -> Path:
        """The run in the simulation as it is given."""
        return self.folder / "trained"

    @property
    def tuned(self) -> Path:
        """The run that goes on in the improved simulation."""
        return self.folder / "tuned"

    @property
    def control(self) -> Path:
        """The run that goes on in the given simulation."""
        return self.folder / "control"

    @property
    def diagnosis(self) -> Path:
        return self.folder / "diagnosis.json"

    @property
    def improved(self) -> Path:
        """A folder of the same robot, simulated by the improved model."""
        return self.folder / "improved"

    @property
    def report(self) -> Path:
        return self.folder / "report.html"

    @property
    def result(self) -> Path:
        return self.folder / "result.json"

    def played(self, name: str) -> Path:
        """What `openant eval` wrote of a play, such as `robot_before`."""
        return self.folder / f"{name}.json"

    # ------------------------------------------------------------------------------------------------------- stages

    def stages(self) -> tuple[Stage, ...]:
        """The stages in order, as far as what stands lets them be known: which recording is diagnosed, and whether there is
        anything to improve, the ones before say."""
        robot, model = str(self.robot), str(RobotFolder.at(self.robot).model_path())
        before = self._play("robot_before", "play it on the robot, and record that", self.trained, hardware=True)
        first = (
            self._train("train", "train in the simulation", self.trained, self.robot, self.steps),
            self._play("sim_before", "play it there", self.trained),
            before,
            Stage(
                "diagnose",
                "find what the simulation lacks, from that recording",
                (
                    (
                        *("gap", "diagnose", *self._recordings(), "--model", model),
                        *("--json", str(self.diagnosis), "--report", str(self.folder / "gap")),
                    ),
                ),
                before.results,
                (self.diagnosis,),
            ),
        )  # fmt: skip
        control = (
            self._train(
                "control", "train on as long in the simulation as it was", self.control, self.robot,
                self.fine_tune_steps, source=self.trained,
            ),
            self._play("control_sim_after", "play that there", self.control),
            self._play("control_after", "play that on the robot", self.control, hardware=True),
        )  # fmt: skip
        if not self.improves:
            return *first, *control
        improve = Stage(
            "improve",
            "write the improved simulation",
            (
                ("config", "new", "--from", robot, "--robot", str(self.improved)),
                (
                    *("gap", "apply", str(self.diagnosis), "--model", model),
                    *("--robot", str(self.improved), "--out", str(self.improved / "improved.xml")),
                ),
            ),
            (self.diagnosis,),
            (self.improved / "improved.xml", self.improved / CONFIG_NAME),
            replaced=(self.improved,),
        )
        return (
            *first,
            improve,
            self._train(
                "fine-tune", "train on in the improved simulation", self.tuned, self.improved, self.fine_tune_steps,
                source=self.trained, inputs=improve.results,
            ),
            self._play("sim_after", "play it there", self.tuned),
            self._play("robot_after", "play it on the robot", self.tuned, hardware=True),
            *control,
        )  # fmt: skip

    def moves(self, stage: Stage) -> bool:
        """Whether the robot walks in a stage."""
        return any("hardware" in command for command in stage.commands)

    @property
    def improves(self) -> bool:
        """Whether there is anything to improve; True as long as nothing was diagnosed."""
        return not self.diagnosis.is_file() or bool(self._diagnosed().selected)

    def _diagnosed(self) -> Diagnosis:
        return read_diagnosis(self.diagnosis)

    def _recordings(self) -> list[str]:
        """Those of the play on the robot; none as long as it was not played."""
        file = self.played("robot_before")
        return list(read_json(file)["recordings"]) if file.is_file() else []

    def _train(
        self,
        name: str,
        words: str,
        run: Path,
        robot: Path,
        steps: int,
        *,
        source: Path | None = None,
        inputs: tuple[Path, ...] = (),
    ) -> Stage:
        begin = () if source is None else ("--from", str(source))
        settings = () if self.settings is None else ("--settings", str(self.settings))
        return Stage(
            name,
            words,
            (
                (
                    *("train", "sac", "--robot", str(robot), *begin, *settings, "--steps", str(steps)),
                    *("--seed", str(self.seed), "--out", str(run), "--json", str(run / "train.json")),
                ),
            ),
            (*inputs, *(() if source is None else (source / "train.json",))),
            (run / "train.json",),
            outdated=(run,),
        )

    def _play(self, name: str, words: str, run: Path, *, hardware: bool = False) -> Stage:
        where: tuple[str, ...] = ()
        if hardware:
            virtual = () if self.virtual is None else ("--virtual", self.virtual)
            where = ("--env", "hardware", "--robot", str(self.robot), *virtual, "--yes")
        return Stage(
            name,
            words,
            (
                (
                    *("eval", str(run), *where, "--seconds", literal(self.seconds), "--starts", str(self.starts)),
                    *("--seed", str(self.seed), "--json", str(self.played(name))),
                ),
            ),
            (run / "train.json",),
            (self.played(name),),
        )

    # ------------------------------------------------------------------------------------------------------ beginning

    def prepare(self) -> None:
        """Refuse now what would be refused after hours, and mark the folder as this loop's.

        Raises:
            BadInput: the robot cannot walk as it is described, there is no such virtual robot, or the folder holds
                something else.
        """
        folder = RobotFolder.at(self.robot)
        config = folder.config()
        from openant_env.link import engine_config  # NumPy and the bus: only here

        placeholder = None if self.virtual is None else "virtual"
        engine_config(config, rate_hz=RATE_HZ, bus="unopened", imu=placeholder, camera=placeholder, folder=folder)
        if self.virtual is not None:
            _check_virtual(self.virtual)
        simulated = hashlib.sha256(folder.model_path(config).read_bytes())
        simulated.update(repr(config.effects).encode())
        asked = {
            **{key: str(value) if isinstance(value, Path) else value for key, value in asdict(self).items()},
            SIMULATION: simulated.hexdigest()[:16],
        }
        del asked["folder"]
        kept = self.folder / ASKED
        if kept.is_file():
            before = read_json(kept, "name a new folder with --out")
            for key, value in asked.items():
                if before.get(key) == value:
                    continue
                what = f"holds a loop with {key.replace('_', ' ')} {before.get(key)}, not {value}"
                if key == SIMULATION:
                    what = "holds a loop that began with another model or other effects of this robot"
                raise BadInput(what, where=self.folder, remedy="name a new folder with --out")
            return
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise BadInput("holds something that is no loop", where=self.folder, remedy="name a new folder with --out")
        write_text(kept, json_text(asked))


def _check_virtual(source: str) -> None:
    """Refuse a virtual robot that will not start, or will not walk; a sealed one is not opened."""
    if source == VIRTUAL_DEFAULT or not source.endswith(".toml"):
        return  # a ready file's robot runs already
    if not Path(source).is_file():
        remedy = "name a scenario (NAME.toml), or give --virtual alone for a healthy robot"
        raise BadInput("there is no such scenario", where=source, remedy=remedy)
    _, table = read_scenario_file(Path(source))
    if not is_sealed(table):
        load_scenario(Path(source))
    elif not os.environ.get(KEY_VARIABLE):
        raise BadInput("is sealed", where=source, remedy=f"name its key file: {KEY_VARIABLE}=FILE")
    else:
        read_key(Path(os.environ[KEY_VARIABLE]))
    if not placeable(source) and table.get("robot", {}).get("setup") != "floor":
        raise BadInput("this robot does not stand on the floor", where=source, remedy='let its setup be "floor"')


# ---------------------------------------------------------------------------------------------------------- what came of it


@dataclass(frozen=True)
class Played:
    """What a policy achieved in one place.

    Attributes:
        rewards_m_s: m/s, sampled, from each start.
        helped: how often the robot had to be set up again.
        step: of the policy's training.
    """

    rewards_m_s: tuple[float, ...]
    helped: int
    step: int

    @classmethod
    def read(cls, path: Path) -> Played:
        """From what `openant eval` wrote."""
        played = read_json(path)
        sampled = played["plays"]["sampled"]
        return cls(
            tuple(float(one["average_reward_m_s"]) for one in sampled),
            sum(sum(one["helped"].values()) for one in sampled),
            int(played["step"]),
        )

    @property
    def mean(self) -> Interval:
        """m/s, with what the starts differ by."""
        return Interval.of_mean(self.rewards_m_s)


@dataclass(frozen=True)
class Result:
    """What came of a loop.

    Attributes:
        diagnosis: of the trained policy's own recording.
        sim_before, robot_before: the trained policy in the given simulation and on the robot.
        sim_after, robot_after: trained on in the improved simulation, there and on the robot; the control's, where there was
            nothing to improve.
        control_sim_after, control_after: trained on in the given simulation, there and on the robot.
        updates: of the networks by run, `trained`, `control` and, where there was something to improve, `tuned`.
    """

    diagnosis: Diagnosis
    sim_before: Played
    robot_before: Played
    sim_after: Played
    robot_after: Played
    control_sim_after: Played
    control_after: Played
    updates: Mapping[str, int]

    @property
    def improved(self) -> bool:
        return bool(self.diagnosis.selected)

    @property
    def plays(self) -> Mapping[str, Played]:
        names = ("sim_before", "robot_before", "sim_after", "robot_after", "control_after", "control_sim_after")
        return {name: getattr(self, name) for name in names}

    @property
    def gain_m_s(self) -> Interval | None:
        """m/s on the robot, of the improvement over the control; None where there was nothing to improve."""
        if not self.improved:
            return None
        return Interval.of_difference(self.robot_after.rewards_m_s, self.control_after.rewards_m_s)

    @property
    def promised_m_s(self) -> Mapping[str, Interval]:
        """By how much a simulation promises more than the robot gives, m/s: `before`, `after` and `control`."""
        pairs = {
            "before": (self.sim_before, self.robot_before),
            "after": (self.sim_after, self.robot_after),
            "control": (self.control_sim_after, self.control_after),
        }
        return {
            name: Interval.of_difference(sim.rewards_m_s, robot.rewards_m_s) for name, (sim, robot) in pairs.items()
        }

    def as_json(self) -> dict[str, Any]:
        """As formats, section 6, has it; what is ours alone comes after."""
        gain = self.gain_m_s
        answer: dict[str, Any] = known({
            "schema": SCHEMA,
            "reward": {name: played.mean.value for name, played in self.plays.items()},
            "verdict": self.diagnosis.verdict,
            "selected": list(self.diagnosis.selected),
            "improved": self.improved,
            "intervals": {name: played.mean.as_json() for name, played in self.plays.items()},
            "starts": {name: list(played.rewards_m_s) for name, played in self.plays.items()},
            "helped": {name: played.helped for name, played in self.plays.items()},
            "sim_minus_robot": {name: span.as_json() for name, span in self.promised_m_s.items()},
            "after_minus_control": None if gain is None else gain.as_json(),
            "updates": dict(self.updates),
        })  # fmt: skip
        return answer


def result_of(loop: Loop) -> Result:
    """What came of a loop whose stages all stand."""
    found = read_diagnosis(loop.diagnosis)
    plays = {
        name: Played.read(loop.played(name))
        for name in ("sim_before", "robot_before", "control_sim_after", "control_after")
    }
    runs = {"trained": loop.trained, "control": loop.control}
    if found.selected:
        plays |= {name: Played.read(loop.played(name)) for name in ("sim_after", "robot_after")}
        runs["tuned"] = loop.tuned
    else:
        plays |= {"sim_after": plays["control_sim_after"], "robot_after": plays["control_after"]}
    return Result(found, **plays, updates={name: _updates(run) for name, run in runs.items()})


def _updates(run: Path) -> int:
    """One a step, once enough was collected to learn from."""
    steps, settings = read_json(run / "train.json")["steps"], read_json(run / "run.json")["settings"]
    return max(0, int(steps) - int(settings["learning_start"]))
