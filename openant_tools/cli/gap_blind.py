"""`openant gap blind`: judge the diagnosis on robots whose answers are sealed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import click

from openant_tools.cli import blind_sets as sets
from openant_tools.cli.log import mention
from openant_tools.cli.options import Number, json_option, out_option, report_option, write_report
from openant_tools.cli.progress import progress_bar
from openant_tools.errors import BadInput

__all__ = ["blind"]


@click.group()
def blind() -> None:
    """Judge the diagnosis on robots whose answers are sealed."""


def _share(name: str, words: str) -> Callable[[click.decorators.FC], click.decorators.FC]:
    return click.option(name, type=Number(0, 1), metavar="SHARE", help=words)


@blind.command()
@out_option
@click.option("--robots", "count", type=click.IntRange(1, 10_000), default=240, show_default=True, metavar="N")
@sets.seed_option
@sets.seed_from_option
@_share("--none", "Robots without effect, of all. Default 0.35.")
@_share("--two", "Robots with two effects. Default 0.15.")
@_share("--outside", "Robots outside the catalogue. Default 0.12.")
@_share("--virtual", "Robots from the virtual robot's bus, where it can have the effect; a minute each. Default 0.5.")
@click.option(
    "--maker",
    metavar="batch|bus|COMMAND",
    help="Who makes all of the robots; COMMAND is called with ANSWER.json and an empty folder (docs/blind.md). "
    "Default: batch and bus, by --virtual.",
)
@sets.key_option
@click.option("--open", "unsealed", is_flag=True, help="Leave the answers open, beside the runs: for development.")
@sets.jobs_option("Robots")
def make(
    out: Path,
    count: int,
    seed: int | None,
    commit: str | None,
    maker: str | None,
    key_file: Path | None,
    unsealed: bool,
    jobs: int,
    **shares: float | None,
) -> None:
    """Draw and simulate a set of robots; what is there already is kept.

    \b
      openant gap blind make --out set --robots 240 --seed-from v1.0 --key-file set.key
      openant gap blind make --out dev --robots 60 --seed 1 --open
      openant gap blind make --out drake --seed 1 --open --maker "drake/bin/python benchmarks/second_generator"
    """
    from openant_tools.blind.draw import Mix
    from openant_tools.blind.make import make_set
    from openant_tools.files import read_toml

    if maker is not None and shares["virtual"] is not None:
        raise BadInput("--virtual shares robots out between batch and bus", remedy="leave it out beside --maker")
    if maker == "bus" and shares["outside"]:
        raise BadInput(
            "the bus has no robots outside the catalogue", remedy="leave --outside out, or say --maker batch"
        )
    drawn_from, full = sets.seed_of_set(seed, commit)
    key = sets.key_of_set(out, key_file, unsealed)
    given: dict[str, Any] = {name: value for name, value in shares.items() if value is not None}
    with progress_bar() as progress:
        commitment = make_set(
            out,
            count,
            drawn_from,
            mix=Mix(**given),
            commit=full,
            key=key,
            maker=maker,
            jobs=jobs,
            progress=progress,
        )
    left_out = len(read_toml(out / "set.toml").get("left_out", []))
    click.echo(
        f"{count - left_out} robots in {out}"
        + (f", {left_out} left out that their maker cannot have" if left_out else "")
    )
    click.echo(f"commitment of their answers: {commitment}")


@blind.command()
@sets.set_argument
@sets.jobs_option("Robots")
@click.option("--backend", type=click.Choice(["loky", "dask", "ray"]), default="loky", show_default=True)
@click.option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster that runs already; else one starts here.")
def run(folder: Path, jobs: int, backend: str, scheduler: str | None) -> None:
    """Diagnose every robot of SET that has no verdict yet; it may be stopped and goes on where it was.

    \b
      openant gap blind run set --jobs 2
      openant gap blind run set --backend dask --scheduler tcp://lab:8786
    """
    from openant_tools.blind.run import Backend, run_set

    with progress_bar() as progress:
        done = run_set(
            folder, jobs=jobs, backend=cast("Backend", backend), scheduler=scheduler, progress=progress
        )  # fmt: skip
    click.echo(f"{done} robots diagnosed, verdicts in {folder / 'verdicts'}")


@blind.command()
@click.argument("folders", metavar="SET…", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--key-file",
    "key_files",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The key of each set's answers, in their order. Default: they are open.",
)
@sets.docs_option
@click.option("--so-far", is_flag=True, help="Only robots that have a verdict; the table says so.")
@json_option
@report_option
def score(
    folders: tuple[Path, ...],
    key_files: tuple[Path, ...],
    docs: Path | None,
    so_far: bool,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Open the answers of one SET or several and compare: exit code 1 where a figure lies below what is asked for first.

    \b
      openant gap blind score set --key-file set.key --docs docs/blind.md
      openant gap blind score a b --key-file a.key --key-file b.key
    """
    from openant_tools.blind.score import read
    from openant_tools.blind.score import score as scored
    from openant_tools.blind.score_report import score_report, table_lines, write_docs
    from openant_tools.files import json_text, write_text
    from openant_tools.virtual.seal import read_key

    if key_files and len(key_files) != len(folders):
        raise BadInput(
            f"{len(key_files)} keys for {len(folders)} sets",
            remedy="give one --key-file for each set, in the same order",
        )
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise BadInput("the same set twice: its robots would count twice", remedy="name each set once")
    keys: list[bytes | None] = [read_key(path) for path in key_files]
    keys += [None] * (len(folders) - len(keys))
    opened = [read(folder, key, so_far=so_far) for folder, key in zip(folders, keys, strict=True)]
    cases = [
        replace(case, robot=f"{folder.name}/{case.robot}") if len(folders) > 1 else case
        for folder, (_, mine) in zip(folders, opened, strict=True)
        for case in mine
    ]
    found = scored([facts for facts, _ in opened], cases)
    for line in table_lines(found):
        click.echo(line)
    click.echo(f"{len(found.failures)} of {len(cases)} robots went wrong")
    if found.missing:
        click.echo(f"{found.missing} of {found.robots} robots have no verdict yet and are left out")
    if json_file:
        write_text(json_file, json_text(found.as_json()))
    if report:
        write_report(score_report(found), report, folders)
    if docs:
        write_docs(found, docs)
        mention(f"wrote {docs}")
    if any(row.reached == "below" for rows in found.makers.values() for row in rows):
        click.get_current_context().exit(1)
