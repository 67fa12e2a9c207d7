"""`openant policies`: which simulation ranks policies as the robot does, and which policies it is fooled by."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_agents.places import STARTS_IN_SIMULATION, STARTS_ON_A_ROBOT, Place
from openant_tools.cli.hardware import Moving
from openant_tools.cli.learning import need_agents
from openant_tools.cli.options import SECONDS, json_option, report_option, write_report
from openant_tools.cli.progress import progress_bar
from openant_tools.cli.walking import may_walk
from openant_tools.errors import BadInput
from openant_tools.numbers import number, percent

if TYPE_CHECKING:
    from openant_agents.ranking import PlaceResult, Ranking

__all__ = ["policies"]

policies_option = click.option(
    "--policies", "folder", type=click.Path(path_type=Path), required=True, metavar="DIR",
    help="A folder with runs of `openant train` in it.",
)  # fmt: skip
play_options = (
    click.option(
        "--seconds", type=SECONDS, default=60.0, show_default=True,
        help="Robot time from each start.",
    ),
    click.option(
        "--starts", "--plays", "starts", type=click.IntRange(min=1), metavar="N",
        help="How often each policy starts anew.  "
        f"[default: {STARTS_IN_SIMULATION} in a simulation, {STARTS_ON_A_ROBOT} on a robot]",
    ),
)  # fmt: skip


def _playing(command: Callable[..., Any]) -> Callable[..., Any]:
    for option in (*play_options, policies_option):
        command = option(command)
    return command


@click.group()
def policies() -> None:
    """Play a set of policies in several places and compare.

    \b
    A place is
      nominal                 the bundled model of the standard kit (nominal:lite of the other)
      DIR                     a robot's folder: its model and the effects of its robot.toml, simulated
      virtual:SCENARIO.toml   a virtual robot behind its bus; virtual:default for a healthy one
      hardware:DIR            the robot itself (needs --yes)
      FILE.json               what was measured before: from `policies play`, or {"policies": {NAME: m/s}}
    """


@policies.command(cls=Moving)
@_playing
@click.option("--on", "place", required=True, metavar="PLACE", help="Where: see `openant policies --help`.")
@click.option("--likeliest", is_flag=True, help="On a robot also its likeliest action. In a simulation always.")
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@click.option(
    "--json", "json_file", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE",
    help="What to write. A file that stands there goes on: what it has is not played again.",
)  # fmt: skip
def play(
    folder: Path, seconds: float, starts: int | None, place: str, likeliest: bool, yes: bool, json_file: Path
) -> None:
    """Play every policy in one place and write what each achieved.

    Ranked is what it achieves sampled, with actions drawn as in training; its likeliest action stands beside it.
    """
    need_agents()
    from openant_agents.ranking import find_policies, read_measured, write_measured

    runs = find_policies(folder)
    done = read_measured(json_file) if json_file.is_file() else {}
    left = {name: run for name, run in runs.items() if name not in done}
    both = likeliest or not Place.named(place).is_robot
    for name, measured in _play(left, place, seconds, starts, yes, likeliest=both):
        done[name] = measured
        write_measured(json_file, done, place=place, seconds=seconds)
        click.echo(f"{name:24} {_achieved(measured)}")


@policies.command(cls=Moving)
@_playing
@click.option("--real", required=True, metavar="PLACE", help="The robot: a place, or what was measured on it.")
@click.option(
    "--sim", "simulations", multiple=True, required=True, metavar="NAME=PLACE", help="A simulation of it. Repeatable."
)
@click.option(
    "--flag-by",
    metavar="NAME",
    help="Flag exploits of this simulation. Default: the first. Give `none` to leave it out.",
)
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@report_option
@json_option
def rank(
    folder: Path,
    seconds: float,
    starts: int | None,
    real: str,
    simulations: tuple[str, ...],
    flag_by: str | None,
    yes: bool,
    report: Path | None,
    json_file: Path | None,
) -> None:
    """Say which simulation ranks policies as the robot does, and what choosing by it costs.

    \b
    Example:
      openant policies rank --policies my-ant/runs --real measured.json \\
        --sim nominal=nominal --sim calibrated=my-ant --sim diagnosed=my-ant-diagnosed --report ranking
    """
    need_agents()
    from openant_agents.ranking import find_policies, play_disturbed
    from openant_agents.ranking import rank as ranked
    from openant_agents.ranking_report import ranking_report
    from openant_tools.files import json_text, write_text

    places = _simulations(simulations)
    if flag_by is not None and flag_by != "none" and flag_by not in places:
        raise BadInput(f"no simulation is called {flag_by}", remedy=f"choose one of {', '.join(places)}, or none")
    runs = find_policies(folder)
    on_robot = dict(_play(runs, real, seconds, starts, yes))
    runs = {name: path for name, path in runs.items() if name in on_robot}
    simulated = {name: dict(_play(runs, place, seconds, starts, False)) for name, place in places.items()}
    found = ranked({name: on_robot[name] for name in runs}, simulated)
    if flag_by != "none":
        chooser = flag_by or next(iter(places))
        worse: dict[str, dict[str, PlaceResult]] = {}
        if not places[chooser].endswith(".json"):
            where = _place(places[chooser], False)
            with progress_bar(where.name) as tell:
                worse = play_disturbed(runs, where, seconds=seconds, starts=starts, progress=tell)
        found = found.flagged(chooser, worse)
    _print(found)
    if report is not None:
        write_report(ranking_report(found), report, [folder])
    if json_file is not None:
        write_text(json_file, json_text(found.as_dict()))


def _print(ranking: Ranking) -> None:
    """Rewards by policy, the best on the robot first, and the figures of each simulation."""
    real, simulated = ranking.real, ranking.simulated
    click.echo(f"{'policy, cm/s':24} {'robot':>11}" + "".join(f" {name:>11}" for name in simulated))
    for policy in sorted(real, key=lambda name: -real[name].average_reward_m_s):
        cells = [real[policy], *(measured[policy] for measured in simulated.values())]
        click.echo(
            f"{policy:24} "
            + " ".join(
                f"{number(100 * one.average_reward_m_s, sign=True, decimals=1):>6} ±{number(100 * one.standard_error_m_s, decimals=1)}"
                for one in cells
            )
        )
    for name, one in ranking.agreements.items():
        s, k, v, r = one.spearman, one.kendall, one.rank_violation_m_s, one.regret_m_s
        click.echo(
            f"{name}: Spearman {number(s.value, low=s.low, high=s.high)}, Kendall {number(k.value, low=k.low, high=k.high)},"
            f" rank violation {number(100 * v.value, 'cm/s', decimals=1)}, regret {number(100 * r.value, 'cm/s', decimals=1)}"
            f" ({percent(one.regret_share)}): its best is number {one.best_is} of {one.policies} on the robot"
        )
    for suspect in ranking.flags:
        click.echo(f"exploit? {suspect.words}")


def _simulations(given: tuple[str, ...]) -> dict[str, str]:
    from openant_agents.ranking import check_names

    places: dict[str, str] = {}
    for text in given:
        name, equals, place = text.partition("=")
        if not (name and equals and place):
            raise BadInput(f"--sim {text} is not NAME=PLACE", remedy="such as --sim calibrated=my-ant")
        if name in places:
            raise BadInput(f"two simulations are called {name}", remedy="give each a name of its own")
        places[name] = place
    check_names(places)
    return places


def _play(
    runs: Mapping[str, Path], place: str, seconds: float, starts: int | None, yes: bool, *, likeliest: bool = False
) -> Iterator[tuple[str, PlaceResult]]:
    """(name, what it achieved) of each policy, with progress; from a file where the place is one."""
    from openant_agents.ranking import play as played
    from openant_agents.ranking import read_measured

    if place.endswith(".json"):
        yield from ((name, one) for name, one in read_measured(Path(place)).items() if name in runs)
        return
    where = _place(place, yes)
    with progress_bar(place) as tell:
        yield from played(runs, where, seconds=seconds, starts=starts, likeliest=likeliest, progress=tell)


def _place(name: str, yes: bool) -> Place:
    """Where to play; a robot only where it may walk."""
    place = Place.named(name)
    if place.is_hardware:
        may_walk(place.options, yes)
    return place


def _achieved(measured: PlaceResult) -> str:
    """Both ways of a policy in a line, in cm/s."""
    plays, starts = measured.plays, len(measured.plays)
    words = f"sampled {number(100 * measured.median, 'cm/s', sign=True, decimals=1):>11}"
    if starts > 1:
        words += f" ({number(100 * min(plays), sign=True, decimals=1)} to {number(100 * max(plays), sign=True, decimals=1)} in {starts} starts)"
    if measured.likeliest is not None:
        likeliest = measured.likeliest
        words += f", likeliest {number(100 * likeliest['median'], sign=True, decimals=1):>5}"
        if likeliest["stood_still"]:
            words += f" (stood still for good in {number(likeliest['stood_still'])} of {starts})"
    return words
