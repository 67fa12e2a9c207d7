"""What `openant train sac` and `openant train sarsa` share: where they train, how they stop, and what they show."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_agents.places import HARDWARE_ID, SIMULATED_ID
from openant_tools.bringup.gait import STEP_S, steps_of
from openant_tools.cli.learning import LearningBar, kit_option, need_agents, robot_argument
from openant_tools.cli.log import mention
from openant_tools.cli.options import robot_option
from openant_tools.cli.walking import (
    environment,
    hardware_options,
    hardware_robot,
    may_walk,
)
from openant_tools.errors import BadInput, HardwareFault, OpenAntError, StorageFault
from openant_tools.numbers import exact, number

if TYPE_CHECKING:
    from openant_agents.training import TrainingProgress

__all__ = ["TrainingPlace", "effects_option", "show_result", "tensorboard_option", "training", "training_options"]

effects_option = click.option(
    "--effects/--no-effects", default=True, help="Whether the robot's [[effect]] entries act.  [default: on]"
)
tensorboard_option = click.option(
    "--tensorboard", is_flag=True, help="Also write TensorBoard events into the run's folder."
)


@dataclass(frozen=True)
class TrainingPlace:
    """Where an agent trains.

    Attributes:
        name, options: the environment's id and options, as `run.json` keeps them.
        yes: a robot there may move without a question.
        unattended: nobody looks after it once it moves.
    """

    name: str
    options: dict[str, Any]
    yes: bool
    unattended: bool

    @property
    def hardware(self) -> bool:
        return self.name == HARDWARE_ID


def training_options(agent: str, leaves: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The robot and where it trains, as `place`; `--steps`, `--seed`, `--out`, `--task`.

    Args:
        agent: of which an hour of robot time is the default. leaves: what is in a run's folder, in words.
    """
    hour = steps_of(agent, 60)
    options = (
        robot_option,
        kit_option,
        click.option(
            "--env", "where", type=click.Choice(["sim", "hardware"]), default="sim", show_default=True,
            help="Where to train: in the simulation, or on the robot itself (with --virtual on a virtual one).",
        ),
        hardware_options,
        click.option(
            "--unattended", is_flag=True,
            help="Nobody looks after the robot: tells beforehand what goes on by itself and how often, asks nothing afterwards, "
            "and where someone is needed ends, torque off and saved.",
        ),
        click.option(
            "--steps", type=click.IntRange(min=1), default=hour, show_default=True,
            help=f"Train until the run is this long; {hour} steps of {exact(STEP_S[agent], 's')} are an hour.",
        ),
        click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True),
        click.option(
            "--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
            help=f"The run's folder: {leaves}. A run that stands there goes on.",
        ),
        click.option(
            "--from", "source", type=click.Path(path_type=Path, file_okay=False), metavar="RUN",
            help="Begin with the agent of another run: its policy acts from the first step on, and learns on.",
        ),
        click.option(
            "--task", type=click.Choice(["back-and-forth", "forward"]), default="back-and-forth", show_default=True
        ),
    )  # fmt: skip

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def placed(
            robot: Path | None,
            kit: str | None,
            where: str,
            virtual_source: str | None,
            clock: str | None,
            yes: bool,
            unattended: bool,
            task: str,
            effects: bool,
            record_pictures: bool,
            **rest: Any,
        ) -> Any:
            need_agents()
            name, chosen = _place_of(where, robot, kit, virtual_source, clock, task, effects, record_pictures)
            if unattended and name != HARDWARE_ID:
                raise BadInput(
                    "--unattended is for a robot", remedy="add --env hardware; nobody looks after a simulation"
                )
            return command(place=TrainingPlace(name, chosen, yes, unattended), **rest)

        for option in reversed(options):
            placed = option(placed)
        return placed

    return add


def _place_of(
    where: str,
    robot: Path | None,
    kit: str | None,
    virtual_source: str | None,
    clock: str | None,
    task: str,
    effects: bool,
    pictures: bool,
) -> tuple[str, dict[str, Any]]:
    """The environment's id and options.

    Raises:
        BadInput: options that do not go together, or no such robot.
    """
    hardware = where == "hardware"
    if virtual_source is not None and not hardware:
        raise BadInput("--virtual is a robot behind its ports", remedy="add --env hardware")
    if pictures and not hardware:
        raise BadInput("--record-pictures is of a robot's camera", remedy="add --env hardware")
    chosen = hardware_robot(robot, kit, virtual_source, clock) if hardware else robot_argument(robot, kit)
    options: dict[str, Any] = {**chosen, "task": task}
    if not effects and not hardware:
        options["effects"] = False
    if pictures:
        options["record_pictures"] = True
    return HARDWARE_ID if hardware else SIMULATED_ID, options


@contextlib.contextmanager
def training(place: TrainingPlace, steps: int, out: Path) -> Iterator[tuple[Any, LearningBar]]:
    """The environment, once a robot may move, and the bar; what ends it early says how to go on."""
    if not place.hardware:
        with (
            environment(place.name, place.options, out / "recordings") as env,
            _going_on(out),
            LearningBar(steps, out) as bar,
        ):
            yield env, bar
        return
    from openant_tools.bringup.run_log import add_to_log

    may_walk(place.options, place.yes, place.unattended)
    said = functools.partial(add_to_log, out)
    kept = environment(place.name, place.options, out / "recordings", unattended=place.unattended, said=said)
    with _told_at_its_end(out), kept as env, _going_on(out), LearningBar(steps, out) as bar:
        said("begun, unattended" if place.unattended else "begun")
        yield env, bar


@contextlib.contextmanager
def _going_on(out: Path) -> Iterator[None]:
    """What ends a run early says how to go on."""
    try:
        yield
    except (KeyboardInterrupt, HardwareFault):
        mention(f"saved in {out}; the same command goes on from there")
        raise


@contextlib.contextmanager
def _told_at_its_end(out: Path) -> Iterator[None]:
    """However a run on a robot ends, its log says why; unless somebody wants it gone at once, it has its page."""
    from openant_tools.bringup.run_log import add_to_log

    why, page = "by a fault of this program", True
    try:
        try:
            yield
        except OSError as error:
            raise StorageFault(
                f"nothing more is saved, and the robot stops: {error.strerror or error}",
                where=error.filename or out,
                remedy="make room there; the same command goes on",
            ) from error
        why = "all steps are done"
    except KeyboardInterrupt:
        why, page = "interrupted", False
        mention(f"its page: openant train report {out}")
        raise
    except OpenAntError as error:
        why = str(error)
        raise
    finally:
        add_to_log(out, f"ended: {why}")
        if page:
            _page(out)


def _page(out: Path) -> None:
    """The run's page, as far as there is something to tell."""
    from openant_tools.bringup.training_report import read_training, training_report

    if not any((out / "recordings").glob("*.mcap")):
        return
    try:
        report = training_report(read_training(out))
        report.made_by = f"openant train report {out}"
        mention(f"wrote {report.write_folder(out / 'report')}")
    except (OpenAntError, OSError) as error:
        click.echo(f"without a page: {error}", err=True)


def show_result(
    agent: str,
    result: TrainingProgress,
    out: Path,
    json_file: Path | None,
    *,
    words: Sequence[str] = (),
    more: Mapping[str, Any] | None = None,
    learning_from_s: float | None = None,
    begun: bool = True,
) -> None:
    """Print how far a run came, draw its curve, and write the JSON that was asked for.

    Args:
        words: lines of this agent. more: its part of the JSON.
        learning_from_s: s of robot time at which updates began.
        begun: whether it has learned something that can be evaluated.
    """
    from openant_agents.curves import plot_curves
    from openant_agents.runs import read_curve

    curve = read_curve(out)
    picture = out / "learning_curve.png"
    if curve:
        plot_curves({agent: curve}, picture, learning_from_s=learning_from_s)
    helped = ", ".join(f"{count}× {reason}" for reason, count in result.helped.items())
    click.echo(
        f"{result.step} steps, {number(result.robot_seconds / 60, 'min', decimals=1)} of robot time: "
        f"{number(100 * result.average_reward_m_s, 'cm/s', sign=True, decimals=1)} over the last 120 s"
        + (f" (set up again: {helped})" if helped else "")
        + (f", {result.late} steps began late" if result.late else "")
        + ("" if result.updates is None else f", {result.updates} updates")
    )
    for line in words:
        click.echo(line)
    click.echo(f"run: {out}" + (f"   curve: {picture}" if curve else ""))
    click.echo(
        f"next: openant eval {out} --seconds 120" if begun else "next: the same with more --steps; it only explored"
    )
    if json_file is not None:
        from openant_tools.files import json_text, write_text

        answer = {
            "steps": result.step, "seconds": result.robot_seconds, "average_reward_m_s": result.average_reward_m_s,
            "helped": dict(result.helped), "late": result.late, "run": str(out), **(more or {}),
        }  # fmt: skip
        write_text(json_file, json_text(answer, indent=2))
