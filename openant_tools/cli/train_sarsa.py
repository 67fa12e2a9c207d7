"""`openant train sarsa`: learning with few numbers, with progress, a log of decisions and a curve."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.hardware import Moving
from openant_tools.cli.learning import settings_of, settings_option
from openant_tools.cli.options import Number, json_option
from openant_tools.cli.training import (
    TrainingPlace,
    effects_option,
    show_result,
    tensorboard_option,
    training,
    training_options,
)
from openant_tools.numbers import number

__all__ = ["sarsa"]


@click.command(cls=Moving)
@training_options("sarsa", "the log of decisions, learning curve")
@click.option(
    "--dt",
    type=Number(0.0, 10.0, min_open=True),
    default=0.05,
    show_default=True,
    metavar="S",
    help="Length of a step.",
)
@click.option(
    "--action-range", default="sarsa", show_default=True, metavar="NAME", help="paper, platform, sac, sarsa or limits."
)
@effects_option
@click.option("--epsilon", type=Number(0.0, 1.0), help="Share of chance.  [default: 0.255]")
@click.option("--step-size", type=Number(min=0.0, min_open=True), help="Of each weight.  [default: 0.0001]")
@click.option("--reward-scale", type=Number(min=0.0, min_open=True), help="Factor on rewards.  [default: 5]")
@settings_option
@tensorboard_option
@json_option
def sarsa(
    place: TrainingPlace,
    steps: int,
    seed: int,
    out: Path,
    source: Path | None,
    dt: float,
    action_range: str,
    epsilon: float | None,
    step_size: float | None,
    reward_scale: float | None,
    settings_file: Path | None,
    tensorboard: bool,
    json_file: Path | None,
) -> None:
    """Train SARSA(λ) on tile-coded observations and eight motion primitives, with the settings of the Open Ant paper.

    Bounds of observations come from the robot's folder; those that were not measured there are taken from the first
    minute, in which primitives are drawn by chance.

    \b
    Example:
      openant train sarsa --robot my-ant --steps 72000 --seed 1 --out my-ant/runs/sarsa-1
      openant eval my-ant/runs/sarsa-1 --seconds 120
      openant train sarsa --env hardware --robot my-ant --out my-ant/runs/real-sarsa-1
    """
    place.options.update(dt=dt, action_range=action_range)

    from openant_agents.runs import check_free, load_checkpoint
    from openant_agents.sarsa import SarsaSettings
    from openant_agents.sarsa import train as train_sarsa

    given = {"epsilon": epsilon, "step_size": step_size, "reward_scale": reward_scale}
    settings = settings_of(SarsaSettings, settings_file, "sarsa", given)
    env_facts = {"id": place.name, "options": place.options}
    check_free(out, {"agent": "sarsa", "seed": seed, "settings": settings.as_dict(), "env": env_facts})
    with training(place, steps, out) as (env, bar):
        result = train_sarsa(
            env,
            folder=out,
            steps=steps,
            seed=seed,
            settings=settings,
            env_facts=env_facts,
            source=source,
            tensorboard=tensorboard,
            report=bar.show,
        )
    saved = load_checkpoint(out)["agent"]
    learned = saved or {"tiles": 0, "shared": 0, "decisions": 0}
    collisions = f"{learned['shared']} look-ups of tiles that share a row" if learned["shared"] else "no collision"
    share = 100 * learned["tiles"] / settings.table
    words = f"{learned['decisions']} decisions; {learned['tiles']} tiles seen, {number(share, decimals=1)} % of the table; {collisions}"
    more = {
        "decisions": learned["decisions"], "tiles": learned["tiles"], "table": settings.table, "collisions": learned["shared"],
    }  # fmt: skip
    show_result("sarsa", result, out, json_file, words=[words], more=more, begun=saved is not None)
