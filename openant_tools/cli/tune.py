"""`openant tune`: search for settings of an agent, together with other processes and machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from openant_tools.cli.learning import LearningBar, kit_option, need_agents, robot_argument
from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option, robot_option
from openant_tools.errors import BadInput
from openant_tools.numbers import number

__all__ = ["tune"]

#: s and the range of actions that each agent learns with, and steps of an hour
DEFAULTS: dict[str, tuple[dict[str, Any], int]] = {
    "sac": ({}, 30_000),
    "sarsa": ({"dt": 0.05, "action_range": "sarsa"}, 72_000),
}


@click.command()
@click.argument("agent", type=click.Choice(sorted(DEFAULTS)))
@robot_option
@kit_option
@click.option(
    "--storage", default="sqlite:///tune.db", show_default=True, metavar="URL",
    help="Of Optuna: sqlite:///, postgresql://, journal:///FILE. Who names the same shares the work.",
)  # fmt: skip
@click.option("--study", "name", metavar="NAME", help="Default: the agent's name.")
@click.option(
    "--trials", type=click.IntRange(min=1), default=100, show_default=True,
    help="Until the study has so many, those of others included.",
)  # fmt: skip
@click.option("--seeds", type=click.IntRange(min=1), default=10, show_default=True, help="In each trial, from 0.")
@click.option("--steps", type=click.IntRange(min=1), help="Of each seed. Default: an hour of robot time.")
@json_option
def tune(
    agent: str,
    robot: Path | None,
    kit: str | None,
    storage: str,
    name: str | None,
    trials: int,
    seeds: int,
    steps: int | None,
    json_file: Path | None,
) -> None:
    """Search for the settings of AGENT with the highest average reward per second while learning.

    The spaces are the paper's, the sampler is Optuna's default (TPE). Start the same command on as many cores and machines
    as you like; stop and start it as you like.

    \b
    Example:
      openant tune sarsa --robot my-ant --storage sqlite:///tune.db --json best.json
      openant train sarsa --robot my-ant --settings best.json --out my-ant/runs/tuned
    """
    need_agents()
    import importlib.util

    if importlib.util.find_spec("optuna") is None:
        raise BadInput("searching needs Optuna", remedy="pip install 'openant-tools[agents]'")
    import gymnasium

    import openant_env  # noqa: F401  (registers the environment)
    from openant_agents.tuning import best_settings, open_study, search
    from openant_tools.files import json_text, write_text

    defaults, hour = DEFAULTS[agent]
    length = steps or hour
    options = {**robot_argument(robot, kit), **defaults}
    first = gymnasium.make(
        "openant/Ant-v0", max_episode_steps=-1, **options
    )  # what is wrong with the robot shows before the study is made
    facts = {
        "agent": agent, "seeds": seeds, "steps": length, "model_sha256": first.unwrapped.describe()["model_sha256"],
        "options": {key: value for key, value in options.items() if key != "robot"},
    }  # fmt: skip
    first.close()
    study = open_study(storage, name or agent, facts)

    def tell(study: Any, trial: Any) -> None:
        if trial.value is None:
            mention(f"trial {trial.number}: {trial.user_attrs.get('failed', trial.state.name.lower())}")
        else:
            each = ", ".join(
                number(100 * value, sign=True, decimals=1) for value in trial.user_attrs["average_reward_m_s"]
            )
            mention(
                f"trial {trial.number}: {number(100 * trial.value, 'cm/s', sign=True, decimals=2)} ({each}); best {number(100 * study.best_value, sign=True, decimals=2)}",
            )

    with LearningBar(length) as bar:
        search(
            study,
            agent,
            lambda: gymnasium.make("openant/Ant-v0", max_episode_steps=-1, **options),
            trials=trials,
            steps=length,
            seeds=range(seeds),
            report=lambda trial, seed, progress: bar.show(progress, f"trial {trial}, seed {seed}"),
            done=tell,
        )
    settings, value = best_settings(study)
    click.echo(
        f"best of {len(study.trials)} trials: {number(100 * value, 'cm/s', sign=True, decimals=2)} while learning"
    )
    for key, chosen in settings.items():
        click.echo(f"  {key:16} {number(chosen)}" if isinstance(chosen, float) else f"  {key:16} {chosen}")
    if json_file is not None:
        answer = {"agent": agent, "average_reward_m_s": value, "settings": settings, "study": study.study_name}
        write_text(json_file, json_text(answer, indent=2))
        click.echo(f"next: openant train {agent} --settings {json_file} --out DIR")
