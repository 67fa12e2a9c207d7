"""`openant eval`: play a trained agent and measure it."""

from __future__ import annotations

import os
import shlex
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_agents.places import HARDWARE_ID, SIMULATED_ID, STARTS_IN_SIMULATION, STARTS_ON_A_ROBOT, simulated_options
from openant_tools.cli.hardware import Moving
from openant_tools.cli.options import SECONDS, json_option
from openant_tools.cli.progress import progress_bar
from openant_tools.cli.walking import (
    environment,
    hardware_options,
    hardware_robot,
    may_walk,
)
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.relay import part_of

if TYPE_CHECKING:
    from openant_agents.evaluate import Plays
    from openant_agents.policies import Policy

#: s of walking that are filmed at most; pictures in a strip, and s between them
FILM_S = 10.0
STRIP_FRAMES = 8
STRIP_EVERY_S = 0.6
#: what the lines of the two ways begin with
LABELS = {"sampled": "sampled, as in training", "likeliest": "likeliest action, without chance"}


@click.command(cls=Moving)
@click.argument("run", type=click.Path(path_type=Path, file_okay=False), metavar="DIR")
@click.option("--seconds", type=SECONDS, default=120.0, show_default=True, help="Robot time from each start.")
@click.option(
    "--starts", type=click.IntRange(min=1), metavar="N",
    help="How often it starts anew: with other headings in the simulation, where it stands on the robot.  "
    f"[default: {STARTS_IN_SIMULATION} in the simulation, {STARTS_ON_A_ROBOT} on the robot]",
)  # fmt: skip
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
@click.option(
    "--likeliest", is_flag=True,
    help="On the robot also without chance: the mean action of SAC, the greedy primitive of SARSA. In the simulation always.",
)  # fmt: skip
@click.option(
    "--strip", type=click.Path(path_type=Path, dir_okay=False), metavar="PNG",
    help="Also write a strip of pictures of the walking robot.",
)  # fmt: skip
@click.option(
    "--video", type=click.Path(path_type=Path, dir_okay=False), metavar="WEBP",
    help="Also write a short video of it as an animated WebP, and as an .mp4 beside it where ffmpeg is found.",
)  # fmt: skip
@json_option
def eval_(
    run: Path,
    seconds: float,
    starts: int | None,
    seed: int,
    robot: Path | None,
    where: str | None,
    virtual_source: str | None,
    clock: str | None,
    yes: bool,
    record_pictures: bool,
    likeliest: bool,
    strip: Path | None,
    video: Path | None,
    json_file: Path | None,
) -> None:
    """Play the agent of a training run from several starts and measure its average reward per second.

    It is played as in training, with actions drawn by chance (sampled), and with the action that it holds best (likeliest).

    \b
    Example:
      openant eval my-ant/runs/sac-1 --seconds 60 --json eval.json --video walk.webp
      openant eval my-ant/runs/sac-1 --seconds 120 --env hardware --robot my-ant
    """
    from openant_tools.cli.learning import need_agents

    need_agents()
    from openant_agents.evaluate import LIKELIEST, SAMPLED, evaluate
    from openant_agents.policies import load_policy
    from openant_agents.runs import making_sense, read_facts
    from openant_agents.training import place_circle
    from openant_env.rendering import NoOpenGL
    from openant_tools.files import json_text, write_text

    facts = read_facts(run)
    with making_sense(run):
        options = dict(facts["env"]["options"])
        name = {None: str(facts["env"]["id"]), "sim": SIMULATED_ID, "hardware": HARDWARE_ID}[where]
        trained_on = options.get("robot")
    if ":" in name:  # Gymnasium would import what stands before it
        raise BadInput(f"its environment {name!r} names a module", where=run, remedy="train into another folder")
    if name == HARDWARE_ID:
        if where is not None or virtual_source is not None or robot is not None:
            for key in ("kit", "effects", "virtual", "clock", "robot"):
                options.pop(key, None)
            options |= hardware_robot(robot, None, virtual_source, clock)
        if strip is not None or video is not None:
            raise BadInput(
                "a robot paints no pictures of itself",
                remedy="leave --strip and --video out; its recording can be replayed",
            )
        options["record_pictures"] = record_pictures
        may_walk(options, yes)
    elif record_pictures:
        raise BadInput("--record-pictures is of a robot's camera", remedy="add --env hardware")
    elif (strip is not None or video is not None) and name != SIMULATED_ID:
        raise BadInput(f"{name} paints no pictures", remedy="leave --strip and --video out")
    elif virtual_source is not None:
        raise BadInput("--virtual is a robot behind its ports", remedy="add --env hardware")
    else:
        options = simulated_options(options, robot if name == SIMULATED_ID else None)
    if (name != SIMULATED_ID or robot is None) and not os.path.exists(options.get("robot", os.curdir)):
        raise BadInput(
            f"the robot it was trained on is no longer at {options['robot']}", where=run, remedy="name it with --robot"
        )
    simulated = name != HARDWARE_ID
    more: dict[str, Any] = {"render_mode": "rgb_array"} if name == SIMULATED_ID else {}
    starts = starts or (STARTS_IN_SIMULATION if simulated else STARTS_ON_A_ROBOT)
    ways = (SAMPLED, LIKELIEST) if simulated or likeliest else (SAMPLED,)
    before = set((run / "recordings").glob("*.mcap"))
    with environment(name, options, run / "recordings", **more) as env:
        policy = load_policy(run, env)
        if options.get("robot") == trained_on:
            place_circle(env, run)
        found = []
        with progress_bar("walking") as bar:
            for played, way in enumerate(ways):
                tell = part_of(bar, played, len(ways))
                found.append(evaluate(env, policy, way=way, seconds=seconds, starts=starts, seed=seed, progress=tell))
        sampled = found[0]
        if strip is not None or video is not None:
            try:
                _film(env, policy, min(FILM_S, seconds), sampled.typical.seed, strip, video)
            except NoOpenGL as error:
                click.echo(f"openant: no pictures of it: {error}", err=True)
    for plays in found:
        click.echo(_line(plays, seconds))
    click.echo(f"policy of step {policy.step}{_helped(found)}")
    if found[-1].stood_still and found[-1].way == LIKELIEST:
        click.echo(
            f"its likeliest action holds a pose whose likeliest action is that pose: in {found[-1].stood_still} of {starts} "
            "starts nothing moved any more. Chance takes it out of there: play it sampled. Longer training helps, which "
            "brings the gait from chance into the mean (look at the learning curve: is it still rising?)"
        )
    recorded = sorted(set((run / "recordings").glob("*.mcap")) - before, key=lambda path: path.stat().st_mtime)
    if recorded and "robot" in options:
        words = shlex.join(["openant", "gap", "diagnose", str(recorded[-1]), "--robot", str(options["robot"])])
        click.echo(f"what of it the simulation lacks: {words}")
    if json_file is not None:
        answer: dict[str, Any] = {
            "average_reward_m_s": sampled.mean, "starts": starts, **{plays.way: plays.as_dict() for plays in found},
            "seconds": seconds, "seed": seed, "run": str(run), "step": policy.step,
            "recordings": [str(path) for path in recorded],
            "plays": {plays.way: [asdict(play) for play in plays.plays] for plays in found},
        }  # fmt: skip
        write_text(json_file, json_text(answer, indent=2))


def _line(plays: Plays, seconds: float) -> str:
    """What it achieved in one way of acting, in a line."""
    starts = len(plays.plays)
    spread = (
        ""
        if starts == 1
        else f", median of {starts} starts ({number(100 * plays.low, sign=True, decimals=1)} to {number(100 * plays.high, sign=True, decimals=1)})"
    )
    still = f"; stood still for good in {plays.stood_still} of {starts}" if plays.stood_still else ""
    turns, path = (statistics.median(getattr(play, what) for play in plays.plays) for what in ("turns", "path_m"))
    return (
        f"{LABELS[plays.way]}: {number(100 * plays.median, 'cm/s', sign=True, decimals=1)} over {number(seconds, 's', decimals=0)}{spread}{still}; "
        f"{number(path, 'm')} walked, {number(turns, decimals=0)} turns"
    )


def _helped(found: Sequence[Plays]) -> str:
    helped = sum((plays.helped for plays in found), Counter[str]())
    return "".join(f", set up again {count}× ({reason})" for reason, count in helped.items())


def _film(env: Any, policy: Policy, seconds: float, seed: int, strip: Path | None, video: Path | None) -> None:
    """Let it walk once more as sampled, from the start whose reward was the median, and draw it.

    Raises:
        NoOpenGL: there is nothing to draw with.
    """
    from openant_agents.evaluate import SAMPLED, film
    from openant_env.rendering import write_mp4, write_strip, write_video

    env.reset(seed=seed)
    env.render()  # whether it can be drawn, before it walks
    dt = env.unwrapped.dt
    frames = film(env, policy, way=SAMPLED, seconds=seconds, seed=seed)
    if strip is not None:
        apart = max(1, min(round(STRIP_EVERY_S / dt), len(frames) // STRIP_FRAMES))
        write_strip(frames[::apart][:STRIP_FRAMES], strip, seconds_apart=apart * dt)
        click.echo(f"strip: {strip}")
    if video is not None:
        write_video(frames, video, seconds_apart=dt)
        click.echo(f"video: {video}")
        if write_mp4(frames, video.with_suffix(".mp4"), seconds_apart=dt):
            click.echo(f"video: {video.with_suffix('.mp4')}")
