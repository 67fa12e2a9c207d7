"""`openant train`: learning, with progress, checkpoints and a curve."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.options import json_option, robot_folder, robot_option
from openant_tools.errors import BadInput

if TYPE_CHECKING:
    from openant_agents.sac import Progress


def need_torch() -> None:
    """Refuse in one line where the agents' extra is not installed."""
    import importlib.util

    if importlib.util.find_spec("torch") is None:
        raise BadInput("agents need torch, which is not installed", remedy="pip install 'openant-tools[agents]'")


def robot_argument(robot: Path | None, kit: str | None) -> dict[str, str]:
    """How the environment is told which robot: the folder named or lying here, else the nominal robot by its kit."""
    if kit is not None:
        if robot is not None:
            raise BadInput("--robot and --kit name two robots", remedy="give one of them")
        return {"kit": kit}
    return {"robot": os.path.abspath(robot_folder(robot))}


@click.group()
def train() -> None:
    """Train an agent to walk.

    Ctrl-C saves the run and stops; the same command goes on where it stopped.
    """


@train.command()
@robot_option
@click.option("--kit", type=click.Choice(["standard", "lite"]), help="The bundled nominal robot, instead of --robot.")
@click.option("--env", "where", type=click.Choice(["sim"]), default="sim", show_default=True, help="Where to train.")
@click.option(
    "--steps", type=click.IntRange(min=1), default=30_000, show_default=True,
    help="Train until the run is this long; 30,000 steps of 0.12 s are an hour.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
    help="The run's folder: checkpoints, transitions, learning curve. A run that stands there goes on.",
)  # fmt: skip
@click.option("--task", type=click.Choice(["back-and-forth", "forward"]), default="back-and-forth", show_default=True)
@click.option("--dt", type=float, metavar="S", help="Length of a step. Default: the robot's, 0.12 s.")
@click.option("--action-range", metavar="NAME", help="paper, platform, sac, sarsa or limits. Default: the robot's.")
@click.option("--effects/--no-effects", default=True, help="Whether the robot's [[effect]] entries act.  [default: on]")
@click.option(
    "--learning-start", type=click.IntRange(min=1), default=2_000, show_default=True,
    help="Steps with random actions before learning.",
)  # fmt: skip
@click.option(
    "--entropy-start", type=click.FloatRange(min=0.0, min_open=True), default=1.0, show_default=True, metavar="ALPHA",
    help="Weight of the entropy at first; 0.1 explores less and walks sooner.",
)  # fmt: skip
@click.option("--device", default="cpu", show_default=True, help="Where torch computes, such as cpu or cuda.")
@click.option("--tensorboard", is_flag=True, help="Also write TensorBoard events into the run's folder.")
@json_option
def sac(
    robot: Path | None,
    kit: str | None,
    where: str,
    steps: int,
    seed: int,
    out: Path,
    task: str,
    dt: float | None,
    action_range: str | None,
    effects: bool,
    learning_start: int,
    entropy_start: float,
    device: str,
    tensorboard: bool,
    json_file: Path | None,
) -> None:
    """Train soft actor-critic, with the settings of the Open Ant paper.

    \b
    Example:
      openant train sac --robot my-ant --steps 30000 --seed 1 --out my-ant/runs/sac-1
      openant eval my-ant/runs/sac-1 --seconds 120
    """
    need_torch()
    options: dict[str, Any] = {**robot_argument(robot, kit), "task": task}
    if dt is not None:
        options["dt"] = dt
    if action_range is not None:
        options["action_range"] = action_range
    if not effects:
        options["effects"] = False

    import gymnasium

    import openant_env  # noqa: F401  (registers the environment)
    from openant_agents.curves import plot_curves
    from openant_agents.runs import read_curve
    from openant_agents.sac import Settings
    from openant_agents.sac import train as train_sac

    name = "openant/Ant-v0"
    env = gymnasium.make(name, **options)
    settings = Settings(learning_start=learning_start, entropy_start=entropy_start)
    try:
        with _Bar(steps) as bar:
            result = train_sac(
                env,
                folder=out,
                steps=steps,
                seed=seed,
                settings=settings,
                env_facts={"id": name, "options": options},
                device=device,
                tensorboard=tensorboard,
                report=bar.show,
            )
    except KeyboardInterrupt:
        click.echo(f"saved in {out}; the same command goes on from there", err=True)
        raise
    finally:
        env.close()
    curve = read_curve(out)
    picture = out / "learning_curve.png"
    if curve:
        plot_curves({"sac": curve}, picture, learning_from_s=settings.learning_start * env.unwrapped.dt)
    helped = ", ".join(f"{count}× {reason}" for reason, count in result.helped.items())
    click.echo(
        f"{result.step} steps, {result.robot_seconds / 60:.1f} min of robot time: "
        f"{100 * result.average_reward_m_s:+.1f} cm/s over the last 120 s"
        + (f" (set up again: {helped})" if helped else "")
    )
    click.echo(f"run: {out}" + (f"   curve: {picture}" if curve else ""))
    click.echo(f"next: openant eval {out} --seconds 120")
    if json_file is not None:
        from openant_tools.files import write_text

        answer = {
            "steps": result.step, "seconds": result.robot_seconds, "average_reward_m_s": result.average_reward_m_s,
            "helped": dict(result.helped), "run": str(out),
        }  # fmt: skip
        write_text(json_file, json.dumps(answer, indent=2) + "\n")


class _Bar:
    """Progress on stderr: steps, robot time, average reward, steps a second, time left."""

    def __init__(self, steps: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task("learning", total=steps, words="")
        self._begun = False

    def __enter__(self) -> _Bar:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, progress: Progress) -> None:
        if not self._begun:
            # A run that goes on did not get this far in no time.
            self._bar.reset(self._task, completed=progress.step)
            self._begun = True
        speed = self._bar.tasks[self._task].speed
        words = [f"{100 * progress.average_reward_m_s:+5.1f} cm/s", f"{progress.robot_seconds / 60:5.1f} min walked"]
        if speed:
            words.append(f"{speed:4.0f} steps/s")
        self._bar.update(
            self._task,
            completed=progress.step,
            description="learning" if progress.learning else "exploring",
            words="  ".join(words),
        )
