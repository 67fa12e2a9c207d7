"""`openant train`: learning, with progress, checkpoints and a curve."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from openant_tools.cli.learning import LearningBar, need_torch, robot_argument, settings_of, settings_option
from openant_tools.cli.options import json_option, robot_option
from openant_tools.cli.train_sarsa import sarsa
from openant_tools.cli.walking import (
    HARDWARE_ID,
    SIMULATED_ID,
    environment,
    hardware_options,
    hardware_robot,
    may_walk,
)
from openant_tools.errors import BadInput


@click.group()
def train() -> None:
    """Train an agent to walk.

    Ctrl-C saves the run and stops; the same command goes on where it stopped.
    """


@train.command()
@robot_option
@click.option("--kit", type=click.Choice(["standard", "lite"]), help="The bundled nominal robot, instead of --robot.")
@click.option(
    "--env", "where", type=click.Choice(["sim", "hardware"]), default="sim", show_default=True,
    help="Where to train: in the simulation, or on the robot itself (with --virtual on a virtual one).",
)  # fmt: skip
@hardware_options
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
@click.option("--randomise", is_flag=True, help="Each reset another robot, from the intervals of the identification.")
@click.option(
    "--learning-start", type=click.IntRange(min=1), help="Steps with random actions before learning.  [default: 2000]"
)
@click.option(
    "--entropy-start", type=click.FloatRange(min=0.0, min_open=True), metavar="ALPHA",
    help="Weight of the entropy at first; 0.1 explores less and walks sooner.  [default: 1]",
)  # fmt: skip
@settings_option
@click.option(
    "--learn", "learn", type=click.Choice(["between", "beside"]),
    help="Updates between the steps, reproducibly, or beside them in a process of their own, so that acting never waits.  "
    "[default: between in the simulation, beside on a robot]",
)  # fmt: skip
@click.option(
    "--updates-per-step", type=click.FloatRange(min=0.0, min_open=True), default=1.0, show_default=True,
    help="With --learn beside: updates for each step at most.",
)  # fmt: skip
@click.option("--device", default="cpu", show_default=True, help="Where torch computes, such as cpu or cuda.")
@click.option("--tensorboard", is_flag=True, help="Also write TensorBoard events into the run's folder.")
@json_option
def sac(
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
    dt: float | None,
    action_range: str | None,
    effects: bool,
    randomise: bool,
    learning_start: int | None,
    entropy_start: float | None,
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
    """
    need_torch()
    hardware = where == "hardware"
    if virtual_source is not None and not hardware:
        raise BadInput("--virtual is a robot behind its ports", remedy="add --env hardware")
    chosen = hardware_robot(robot, kit, virtual_source, clock) if hardware else robot_argument(robot, kit)
    options: dict[str, Any] = {**chosen, "task": task}
    if dt is not None:
        options["dt"] = dt
    if action_range is not None:
        options["action_range"] = action_range
    if not effects and not hardware:
        options["effects"] = False
    if randomise:
        if hardware:
            raise BadInput("--randomise is for the simulation", remedy="leave it out on a robot")
        options["randomise"] = True
    if learn is None:
        learn = "beside" if hardware else "between"

    from openant_agents.beside import train_beside
    from openant_agents.curves import plot_curves
    from openant_agents.runs import read_curve
    from openant_agents.sac import Settings
    from openant_agents.sac import train as train_sac

    if hardware:
        may_walk(options, yes)
    name = HARDWARE_ID if hardware else SIMULATED_ID
    given = {"learning_start": learning_start, "entropy_start": entropy_start}
    settings = settings_of(Settings, settings_file, "sac", given)
    more: dict[str, Any] = {"updates_per_step": updates_per_step} if learn == "beside" else {}
    with environment(name, options, out / "recordings") as env:
        try:
            with LearningBar(steps, out) as bar:
                result = (train_beside if learn == "beside" else train_sac)(
                    env,
                    folder=out,
                    steps=steps,
                    seed=seed,
                    settings=settings,
                    env_facts={"id": name, "options": options},
                    device=device,
                    tensorboard=tensorboard,
                    report=bar.show,
                    **more,
                )
        except KeyboardInterrupt:
            click.echo(f"saved in {out}; the same command goes on from there", err=True)
            raise
        dt = env.unwrapped.dt
    curve = read_curve(out)
    picture = out / "learning_curve.png"
    if curve:
        plot_curves({"sac": curve}, picture, learning_from_s=settings.learning_start * dt)
    helped = ", ".join(f"{count}× {reason}" for reason, count in result.helped.items())
    click.echo(
        f"{result.step} steps, {result.robot_seconds / 60:.1f} min of robot time: "
        f"{100 * result.average_reward_m_s:+.1f} cm/s over the last 120 s"
        + (f" (set up again: {helped})" if helped else "")
        + (f", {result.late} steps began late" if result.late else "")
        + ("" if result.updates is None else f", {result.updates} updates")
    )
    click.echo(f"run: {out}" + (f"   curve: {picture}" if curve else ""))
    click.echo(f"next: openant eval {out} --seconds 120")
    if json_file is not None:
        from openant_tools.files import write_text

        answer = {
            "steps": result.step, "seconds": result.robot_seconds, "average_reward_m_s": result.average_reward_m_s,
            "helped": dict(result.helped), "late": result.late, "updates": result.updates, "run": str(out),
        }  # fmt: skip
        write_text(json_file, json.dumps(answer, indent=2) + "\n")


train.add_command(sarsa)
