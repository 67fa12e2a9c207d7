"""`openant gap blind`: judge the diagnosis on robots whose answers are sealed."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import click

from openant_tools.cli.options import json_option, out_option, report_option
from openant_tools.errors import BadInput

__all__ = ["blind", "shown_progress"]


@click.group()
def blind() -> None:
    """Judge the diagnosis on robots whose answers are sealed."""


_set_argument = click.argument("folder", type=click.Path(path_type=Path), metavar="SET")
_key_option = click.option(
    "--key-file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="The key of the answers."
)
_jobs_option = click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, metavar="N", help="Robots at the same time."
)


def _share(name: str, words: str) -> Callable[[click.decorators.FC], click.decorators.FC]:
    return click.option(name, type=click.FloatRange(0, 1), metavar="SHARE", help=words)


@blind.command()
@out_option
@click.option("--robots", "count", type=click.IntRange(1, 10_000), default=240, show_default=True, metavar="N")
@click.option("--seed", type=click.IntRange(0), metavar="S", help="Of everything that is drawn.")
@click.option("--seed-from", "commit", metavar="COMMIT", help="Take the seed from a commit's hash: nobody chose it.")
@click.option(
    "--motions",
    "motion_seed",
    type=click.IntRange(0),
    metavar="S",
    help="Seed of the commands. Default: the set's own.",
)
@_share("--none", "Robots without effect, of all. Default 0.35.")
@_share("--two", "Robots with two effects. Default 0.15.")
@_share("--outside", "Robots outside the catalogue. Default 0.12.")
@_share("--virtual", "Robots from the virtual robot's bus, where it can have the effect; a minute each. Default 0.5.")
@_key_option
@click.option("--open", "unsealed", is_flag=True, help="Leave the answers open, beside the runs: for development.")
@_jobs_option
def make(
    out: Path,
    count: int,
    seed: int | None,
    commit: str | None,
    motion_seed: int | None,
    key_file: Path | None,
    unsealed: bool,
    jobs: int,
    **shares: float | None,
) -> None:
    """Draw and simulate a set of robots; what is there already is kept.

    \b
      openant gap blind make --out set --robots 240 --seed-from v1.0 --key-file set.key
      openant gap blind make --out dev --robots 60 --seed 1 --open
    """
    from openant_tools.blind.draw import Mix
    from openant_tools.blind.make import make_set, seed_of_commit
    from openant_tools.virtual.seal import make_key, read_key

    full = None
    if commit is not None:
        if seed is not None:
            raise BadInput("a set has one seed", remedy="give --seed or --seed-from, not both")
        seed, full = seed_of_commit(commit)
    if seed is None:
        raise BadInput("a set needs a seed", remedy="give --seed-from COMMIT, or --seed S")
    if unsealed == (key_file is not None):
        raise BadInput("the answers are to be sealed or open", remedy="give --key-file FILE or --open")
    key = None
    if key_file is not None:
        if key_file.resolve().is_relative_to(out.resolve()):
            raise BadInput("the key would lie beside what it seals", where=key_file, remedy="keep it outside the set")
        key = read_key(key_file) if key_file.exists() else make_key(key_file)
    given: dict[str, Any] = {name: value for name, value in shares.items() if value is not None}
    with shown_progress() as progress:
        commitment = make_set(
            out,
            count,
            seed,
            mix=Mix(**given),
            commit=full,
            key=key,
            motion_seed=motion_seed,
            jobs=jobs,
            progress=progress,
        )
    click.echo(f"{count} robots in {out}")
    click.echo(f"commitment of their answers: {commitment}")


@blind.command()
@_set_argument
@_jobs_option
@click.option("--backend", type=click.Choice(["loky", "dask", "ray"]), default="loky", show_default=True)
@click.option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster that runs already; else one starts here.")
def run(folder: Path, jobs: int, backend: str, scheduler: str | None) -> None:
    """Diagnose every robot of SET that has no verdict yet; it may be stopped and goes on where it was.

    \b
      openant gap blind run set --jobs 2
      openant gap blind run set --backend dask --scheduler tcp://lab:8786
    """
    from openant_tools.blind.run import Backend, run_set

    with shown_progress() as progress:
        done = run_set(
            folder, jobs=jobs, backend=cast("Backend", backend), scheduler=scheduler, progress=progress
        )  # fmt: skip
    click.echo(f"{done} robots diagnosed, verdicts in {folder / 'verdicts'}")


@blind.command()
@_set_argument
@_key_option
@click.option(
    "--docs", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the page of the docs."
)
@json_option
@report_option
def score(folder: Path, key_file: Path | None, docs: Path | None, json_file: Path | None, report: Path | None) -> None:
    """Open the answers of SET and compare: exit code 1 where a figure lies below what is asked for first.

    \b
      openant gap blind score set --key-file set.key --docs docs/blind.md
    """
    from openant_tools.blind.score import read
    from openant_tools.blind.score import score as scored
    from openant_tools.blind.score_report import score_report, table_lines, write_docs
    from openant_tools.files import write_text
    from openant_tools.virtual.seal import read_key

    facts, cases = read(folder, None if key_file is None else read_key(key_file))
    found = scored(facts, cases)
    for line in table_lines(found):
        click.echo(line)
    click.echo(f"{len(found.failures)} of {len(cases)} robots went wrong")
    if json_file:
        write_text(json_file, json.dumps(found.as_json(), indent=1) + "\n")
    if report:
        click.echo(f"wrote {score_report(found).write_folder(report)}", err=True)
    if docs:
        write_docs(found, docs)
        click.echo(f"wrote {docs}", err=True)
    if any(row.reached == "below" for row in found.rows):
        click.get_current_context().exit(1)


@contextlib.contextmanager
def shown_progress() -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda words, share: bar.update(task, description=words, completed=share)
