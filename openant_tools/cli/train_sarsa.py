"""`openant train sarsa`: learning with few numbers, with progress, a log of decisions and a curve."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from openant_tools.cli.learning import LearningBar, need_torch, robot_argument, settings_of, settings_option
from openant_tools.cli.options import json_option, robot_option
from openant_tools.cli.walking import (
    HARDWARE_ID,
    SIMULATED_ID,
    environment,
    hardware_options,
    hardware_robot,
    may_walk,
)
from openant_tools.errors import BadInput

__all__ = ["sarsa"]


@click.command()
@robot_option
@click.option("--kit", type=click.Choice(["standard", "lite"]), help="The bundled nominal robot, instead of --robot.")
@click.option(
    "--env", "where", type=click.Choice(["sim", "hardware"]), default="sim", show_default=True,
    help="Where to train: in the simulation, or on the robot itself (with --virtual on a virtual one).",
)  # fmt: skip
@hardware_options
@click.option(
    "--steps", type=click.IntRange(min=1), default=72_000, show_default=True,
    help="Train until the run is this long; 72,000 steps of 0.05 s are an hour.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
    help="The run's folder: the log of decisions, learning curve. A run that stands there goes on.",
)  # fmt: skip
@click.option("--task", type=click.Choice(["back-and-forth", "forward"]), default="back-and-forth", show_default=True)
@click.option("--dt", type=float, default=0.05, show_default=True, metavar="S", help="Length of a step.")
@click.option(
    "--action-range", default="sarsa", show_default=True, metavar="NAME", help="paper, platform, sac, sarsa or limits."
)
@click.option("--effects/--no-effects", default=True, help="Whether the robot's [[effect]] entries act.  [default: on]")
@click.option("--epsilon", type=click.FloatRange(0.0, 1.0), help="Share of chance.  [default: 0.255]")
@click.option("--step-size", type=click.FloatRange(min=0.0, min_open=True), help="Of each weight.  [default: 0.0001]")
@click.option("--reward-scale", type=click.FloatRange(min=0.0, min_open=True), help="Factor on rewards.  [default: 5]")
@settings_option
@click.option("--tensorboard", is_flag=True, help="Also write TensorBoard events into the run's folder.")
@json_option
def sarsa(
    robot: Path | None,
    kit: str | None,
    where: str,
    virtual_source: str | None,
    clock: str | None,
    yes: bool,
    steps: int,
    seed: int,
    out: Path,
    task: str,
    dt: float,
    action_range: str,
    effects: bool,
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
    need_torch()
    hardware = where == "hardware"
    if virtual_source is not None and not hardware:
        raise BadInput("--virtual is a robot behind its ports", remedy="add --env hardware")
    chosen = hardware_robot(robot, kit, virtual_source, clock) if hardware else robot_argument(robot, kit)
    options: dict[str, Any] = {**chosen, "task": task, "dt": dt, "action_range": action_range}
    if not effects and not hardware:
        options["effects"] = False

    from openant_agents.curves import plot_curves
    from openant_agents.runs import load_checkpoint, read_curve
    from openant_agents.sarsa import Settings
    from openant_agents.sarsa import train as train_sarsa

    if hardware:
        may_walk(options, yes)
    name = HARDWARE_ID if hardware else SIMULATED_ID
    given = {"epsilon": epsilon, "step_size": step_size, "reward_scale": reward_scale}
    settings = settings_of(Settings, settings_file, "sarsa", given)
    with environment(name, options, out / "recordings") as env:
        try:
            with LearningBar(steps, out) as bar:
                result = train_sarsa(
                    env,
                    folder=out,
                    steps=steps,
                    seed=seed,
                    settings=settings,
                    env_facts={"id": name, "options": options},
                    tensorboard=tensorboard,
                    report=bar.show,
                )
        except KeyboardInterrupt:
            click.echo(f"saved in {out}; the same command goes on from there", err=True)
            raise
    curve = read_curve(out)
    picture = out / "learning_curve.png"
    if curve:
        plot_curves({"sarsa": curve}, picture)
    learned = load_checkpoint(out)["agent"] or {"tiles": 0, "shared": 0, "decisions": 0}
    helped = ", ".join(f"{count}× {reason}" for reason, count in result.helped.items())
    click.echo(
        f"{result.step} steps, {result.robot_seconds / 60:.1f} min of robot time: "
        f"{100 * result.average_reward_m_s:+.1f} cm/s over the last 120 s"
        + (f" (set up again: {helped})" if helped else "")
        + (f", {result.late} steps began late" if result.late else "")
    )
    collisions = f"{learned['shared']} look-ups of tiles that share a row" if learned["shared"] else "no collision"
    click.echo(
        f"{learned['decisions']} decisions; {learned['tiles']} tiles seen,"
        f" {100 * learned['tiles'] / settings.table:.1f} % of the table; {collisions}"
    )
    click.echo(f"run: {out}" + (f"   curve: {picture}" if curve else ""))
    click.echo(f"next: openant eval {out} --seconds 120")
    if json_file is not None:
        from openant_tools.files import write_text

        answer = {
            "steps": result.step, "seconds": result.robot_seconds, "average_reward_m_s": result.average_reward_m_s,
            "helped": dict(result.helped), "late": result.late, "run": str(out), "decisions": learned["decisions"],
            "tiles": learned["tiles"], "table": settings.table, "collisions": learned["shared"],
        }  # fmt: skip
        write_text(json_file, json.dumps(answer, indent=2) + "\n")
