"""`openant eval`: play a trained agent and measure it."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from openant_tools.cli.hardware import Moving
from openant_tools.cli.options import SECONDS, json_option
from openant_tools.cli.walking import (
    HARDWARE_ID,
    SIMULATED_ID,
    environment,
    hardware_options,
    hardware_robot,
    may_walk,
)
from openant_tools.errors import BadInput

#: pictures in a strip, s between them at least, and s of walking before the first
STRIP_FRAMES = 8
STRIP_EVERY_S = 0.12
STRIP_FROM_S = 6.0


@click.command(cls=Moving)
@click.argument("run", type=click.Path(path_type=Path, file_okay=False), metavar="DIR")
@click.option("--seconds", type=SECONDS, default=120.0, show_default=True, help="Robot time.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--robot", type=click.Path(path_type=Path), metavar="DIR",
    help="Play it on another robot than it was trained on.",
)  # fmt: skip
@click.option(
    "--env", "where", type=click.Choice(["sim", "hardware"]),
    help="In the simulation, or on the robot itself (with --virtual on a virtual one).  [default: where it was trained]",
)  # fmt: skip
@hardware_options
@click.option("--explore", is_flag=True, help="Sample actions as in training, instead of taking the likeliest.")
@click.option(
    "--strip", type=click.Path(path_type=Path, dir_okay=False), metavar="PNG",
    help="Also write a strip of pictures of the walking robot.",
)  # fmt: skip
@json_option
def eval_(
    run: Path,
    seconds: float,
    seed: int,
    robot: Path | None,
    where: str | None,
    virtual_source: str | None,
    clock: str | None,
    yes: bool,
    explore: bool,
    strip: Path | None,
    json_file: Path | None,
) -> None:
    """Play the agent of a training run and measure its average reward per second.

    \b
    Example:
      openant eval my-ant/runs/sac-1 --seconds 120 --json eval.json --strip walk.png
      openant eval my-ant/runs/sac-1 --seconds 120 --env hardware --robot my-ant
    """
    from openant_tools.cli.learning import need_agents

    need_agents()
    from rich.console import Console
    from rich.progress import Progress

    from openant_agents.evaluate import evaluate
    from openant_agents.policies import load_policy
    from openant_agents.runs import making_sense, read_facts
    from openant_env.rendering import NoOpenGL, write_strip
    from openant_tools.files import json_text, write_text

    facts = read_facts(run)
    with making_sense(run):
        options = dict(facts["env"]["options"])
        name = {None: str(facts["env"]["id"]), "sim": SIMULATED_ID, "hardware": HARDWARE_ID}[where]
    if ":" in name:  # Gymnasium would import what stands before it
        raise BadInput(f"its environment {name!r} names a module", where=run, remedy="train into another folder")
    if name == HARDWARE_ID:
        if where is not None or virtual_source is not None or robot is not None:
            for key in ("kit", "effects", "virtual", "clock", "robot"):
                options.pop(key, None)
            options |= hardware_robot(robot, None, virtual_source, clock)
        if strip is not None:
            raise BadInput(
                "a robot paints no pictures of itself", remedy="leave --strip out; its recording can be replayed"
            )
        may_walk(options, yes)
    elif virtual_source is not None:
        raise BadInput("--virtual is a robot behind its ports", remedy="add --env hardware")
    else:
        for key in ("virtual", "clock"):
            options.pop(key, None)
    if name == SIMULATED_ID and robot is not None:
        options.pop("kit", None)
        options["robot"] = os.path.abspath(robot)
    elif not os.path.exists(options.get("robot", os.curdir)):
        raise BadInput(
            f"the robot it was trained on is no longer at {options['robot']}", where=run, remedy="name it with --robot"
        )
    more = {"render_mode": "rgb_array"} if name == SIMULATED_ID else {}
    before = set((run / "recordings").glob("*.mcap"))
    with environment(name, options, run / "recordings", **more) as env:
        policy = load_policy(run, env, explore=explore)
        apart = max(1, round(STRIP_EVERY_S / env.unwrapped.dt))
        if strip is not None:
            try:
                env.reset(seed=seed)
                env.render()
            except NoOpenGL as error:
                click.echo(f"openant: no strip: {error}", err=True)
                strip = None
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("walking", total=seconds)
            result, pictures = evaluate(
                env,
                policy.act,
                seconds=seconds,
                seed=seed,
                report=lambda done, average: bar.update(task, completed=done, description=f"{100 * average:+.1f} cm/s"),
                frames=0 if strip is None else STRIP_FRAMES,
                frames_from_s=min(STRIP_FROM_S, 0.5 * seconds),
                frame_every=apart,
                begin=policy.begin,
            )
    if strip is not None:
        write_strip(pictures, strip, seconds_apart=apart * result.seconds / result.steps)
        click.echo(f"strip: {strip}")
    helped = "".join(f", set up again {count}× ({reason})" for reason, count in result.helped.items())
    speed = 100 * result.average_reward_m_s
    click.echo(
        f"{speed:+.1f} cm/s over {result.seconds:.0f} s: {result.progress_m:+.2f} m of progress,"
        f" {result.path_m:.2f} m walked, {result.turns} turns{helped} (policy of step {policy.step})"
    )
    recorded = sorted(set((run / "recordings").glob("*.mcap")) - before, key=lambda path: path.stat().st_mtime)
    if recorded and "robot" in options:
        words = shlex.join(["openant", "gap", "diagnose", str(recorded[-1]), "--robot", str(options["robot"])])
        click.echo(f"what of it the simulation lacks: {words}")
    if json_file is not None:
        write_text(json_file, json_text({**result.as_dict(), "run": str(run), "step": policy.step}, indent=2))
