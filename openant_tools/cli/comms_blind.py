"""`openant comms blind`: judge the attribution of dropouts on soaks whose faults are sealed."""

from __future__ import annotations

import json
from pathlib import Path

import click

from openant_tools.cli.gap_blind import shown_progress
from openant_tools.cli.options import json_option, out_option
from openant_tools.errors import BadInput

__all__ = ["blind"]


@click.group()
def blind() -> None:
    """Judge the diagnosis of the bus on soaks whose faults are sealed."""


_set_argument = click.argument("folder", type=click.Path(path_type=Path), metavar="SET")
_key_option = click.option(
    "--key-file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="The key of the answers."
)
_jobs_option = click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, metavar="N", help="Soaks at the same time."
)


@blind.command()
@out_option
@click.option("--soaks", "count", type=click.IntRange(1, 10_000), default=320, show_default=True, metavar="N")
@click.option("--seed", type=click.IntRange(0), metavar="S", help="Of everything that is drawn.")
@click.option("--seed-from", "commit", metavar="COMMIT", help="Take the seed from a commit's hash: nobody chose it.")
@click.option("--healthy", type=click.FloatRange(0, 1), metavar="SHARE", help="Healthy soaks. Default a third.")
@click.option("--virtual", type=click.FloatRange(0, 1), metavar="SHARE", help="From the virtual robot. Default 0.25.")
@_key_option
@click.option("--open", "unsealed", is_flag=True, help="Leave the answers open: for development.")
@_jobs_option
def make(
    out: Path,
    count: int,
    seed: int | None,
    commit: str | None,
    healthy: float | None,
    virtual: float | None,
    key_file: Path | None,
    unsealed: bool,
    jobs: int,
) -> None:
    """Draw soaks and write their run tables; what is there already is kept.

    \b
      openant comms blind make --out set --seed-from v1.0 --key-file set.key
      openant comms blind make --out dev --soaks 60 --seed 1 --open
    """
    from openant_tools.blind.make import seed_of_commit
    from openant_tools.blind.soak_set import make_soaks
    from openant_tools.blind.soaks import SoakMix
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
    usual = SoakMix()
    mix = SoakMix(usual.healthy if healthy is None else healthy, usual.virtual if virtual is None else virtual)
    with shown_progress() as progress:
        commitment = make_soaks(out, count, seed, mix=mix, commit=full, key=key, jobs=jobs, progress=progress)
    click.echo(f"{count} soaks in {out}")
    click.echo(f"commitment of their answers: {commitment}")


@blind.command()
@_set_argument
@_jobs_option
def run(folder: Path, jobs: int) -> None:
    """Diagnose every soak of SET that has no verdict yet; it may be stopped and goes on where it was."""
    from openant_tools.blind.soak_set import run_soaks

    with shown_progress() as progress:
        done = run_soaks(folder, jobs=jobs, progress=progress)
    click.echo(f"{done} soaks diagnosed, verdicts in {folder / 'verdicts'}")


@blind.command()
@_set_argument
@_key_option
@click.option(
    "--docs", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the page of the docs."
)
@click.option("--so-far", is_flag=True, help="Only soaks that have a verdict; the page says so.")
@json_option
def score(folder: Path, key_file: Path | None, docs: Path | None, so_far: bool, json_file: Path | None) -> None:
    """Open the answers of SET and compare: exit code 1 where a figure lies below what is asked for."""
    from openant_tools.blind.soak_score import score_soaks, table_lines, write_soak_docs
    from openant_tools.files import write_text
    from openant_tools.virtual.seal import read_key

    found = score_soaks(folder, None if key_file is None else read_key(key_file), so_far=so_far)
    for line in table_lines(found):
        click.echo(line)
    click.echo(f"{len(found.failures)} of {len(found.cases)} soaks went wrong")
    if json_file:
        write_text(json_file, json.dumps(found.as_json(), indent=1) + "\n")
    if docs:
        write_soak_docs(found, docs)
        click.echo(f"wrote {docs}", err=True)
    if not found.good:
        click.get_current_context().exit(1)
