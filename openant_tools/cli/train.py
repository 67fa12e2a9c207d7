"""`openant train`: learning, with progress, checkpoints and a curve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from openant_tools.cli.hardware import Moving
from openant_tools.cli.learning import settings_of, settings_option
from openant_tools.cli.options import Number, json_option
from openant_tools.cli.train_report import report
from openant_tools.cli.train_sarsa import sarsa
from openant_tools.cli.training import (
    TrainingPlace,
    effects_option,
    show_result,
    tensorboard_option,
    training,
    training_options,
)
from openant_tools.errors import BadInput


@click.group()
def train() -> None:
    """Train an agent to walk.

    Ctrl-C saves the run and stops; the same command goes on where it stopped.
    """


@train.command(cls=Moving)
@training_options("sac", "checkpoints, transitions, learning curve")
@click.option(
    "--dt", type=Number(0.0, 10.0, min_open=True), metavar="S", help="Length of a step. Default: the robot's, 0.12 s."
)
@click.option("--action-range", metavar="NAME", help="paper, platform, sac, sarsa or limits. Default: the robot's.")
@effects_option
@click.option("--randomise", is_flag=True, help="Each reset another robot, from the intervals of the identification.")
@click.option(
    "--learning-start", type=click.IntRange(min=1), help="Steps with random actions before learning.  [default: 2000]"
)
@click.option(
    "--entropy-start", type=Number(min=0.0, min_open=True), metavar="ALPHA",
    help="Weight of the entropy at first; 0.1 explores less and walks sooner.  [default: 1]",
)  # fmt: skip
@click.option(
    "--batch", type=click.IntRange(min=1),
    help="Transitions in an update; half as many take about three quarters of the time, for a first look.  [default: 256]",
)  # fmt: skip
@settings_option
@click.option(
    "--learn", "learn", type=click.Choice(["sync", "async"]),
    help="Updates between the steps, reproducibly, or in a process of their own, so that acting never waits.  "
    "[default: sync in the simulation, async on a robot]",
)  # fmt: skip
@click.option(
    "--updates-per-step", type=Number(min=0.0, min_open=True), default=1.0, show_default=True,
    help="With --learn async: updates for each step at most.",
)  # fmt: skip
@click.option("--device", default="cpu", show_default=True, help="Where torch computes, such as cpu or cuda.")
@tensorboard_option
@json_option
def sac(
    place: TrainingPlace,
    steps: int,
    seed: int,
    out: Path,
    source: Path | None,
    dt: float | None,
    action_range: str | None,
    randomise: bool,
    learning_start: int | None,
    entropy_start: float | None,
    batch: int | None,
    settings_file: Path | None,
    learn: str | None,
    updates_per_step: float,
    device: str,
    tensorboard: bool,
    json_file: Path | None,
) -> None:
    """Train soft actor-critic, with the settings of the Open Ant paper.

    \b
    Example:
      openant train sac --robot my-ant --steps 30000 --seed 1 --out my-ant/runs/sac-1
      openant eval my-ant/runs/sac-1 --seconds 120
      openant train sac --env hardware --robot my-ant --out my-ant/runs/real-1
      openant train sac --env hardware --robot my-ant --from my-ant/runs/sac-1 --out my-ant/runs/real-2
    """
    if randomise and place.hardware:
        raise BadInput("--randomise is for the simulation", remedy="leave it out on a robot")
    chosen = {"dt": dt, "action_range": action_range, "randomise": randomise or None}
    place.options.update({name: value for name, value in chosen.items() if value is not None})
    if learn is None:
        learn = "async" if place.hardware else "sync"

    from openant_agents.async_training import train_async
    from openant_agents.runs import check_free
    from openant_agents.sac import SacSettings
    from openant_agents.sac import train as train_sac

    given = {"learning_start": learning_start, "entropy_start": entropy_start, "batch": batch}
    settings = settings_of(SacSettings, settings_file, "sac", given)
    more: dict[str, Any] = {"updates_per_step": updates_per_step} if learn == "async" else {}
    env_facts = {"id": place.name, "options": place.options}
    check_free(out, {"agent": "sac", "seed": seed, "settings": settings.as_dict(), "env": env_facts})
    with training(place, steps, out) as (env, bar):
        result = (train_async if learn == "async" else train_sac)(
            env,
            folder=out,
            steps=steps,
            seed=seed,
            settings=settings,
            env_facts=env_facts,
            source=source,
            device=device,
            tensorboard=tensorboard,
            report=bar.show,
            **more,
        )
        learning_from_s = settings.learning_start * env.unwrapped.dt
    show_result("sac", result, out, json_file, more={"updates": result.updates}, learning_from_s=learning_from_s)


train.add_command(sarsa)
train.add_command(report)
